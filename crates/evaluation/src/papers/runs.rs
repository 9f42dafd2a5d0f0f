//! Monte Carlo runs on all cores. A run is a function of its seed, so the number of cores does not
//! change the results.

use std::sync::atomic::{AtomicUsize, Ordering};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Random numbers of one run.
pub(crate) struct Noise(ChaCha8Rng);

impl Noise {
    /// The random numbers of one run of an experiment.
    pub(crate) fn new(seed: u64, run: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(run as u64);
        Self(rng)
    }

    pub(crate) fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }

    /// Uniform between 0 and 1.
    pub(crate) fn uniform(&mut self) -> f64 {
        rand::RngExt::random(&mut self.0)
    }

    pub(crate) fn add_to(&mut self, samples: &mut [f32], deviation: f32) {
        for sample in samples {
            let normal: f32 = StandardNormal.sample(&mut self.0);
            *sample += deviation * normal;
        }
    }
}

/// The results of runs 0 to `count` in their order.
pub(crate) fn all<T: Send>(count: usize, run: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let workers = std::thread::available_parallelism().map_or(1, usize::from).min(count.max(1));
    let next = AtomicUsize::new(0);
    let mut results: Vec<(usize, T)> = std::thread::scope(|scope| {
        let work = || work(&next, count, &run);
        let threads: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        // If a run panics, the whole experiment does.
        threads
            .into_iter()
            .flat_map(|thread| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            })
            .collect()
    });
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

/// The results of those runs that one worker comes to, with their numbers.
fn work<T>(next: &AtomicUsize, count: usize, run: impl Fn(usize) -> T) -> Vec<(usize, T)> {
    let mut done = Vec::new();
    loop {
        let index = next.fetch_add(1, Ordering::Relaxed);
        if index >= count {
            return done;
        }
        done.push((index, run(index)));
    }
}
