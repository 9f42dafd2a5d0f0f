//! Two areas on real data: the drone of the drone-tracking-datasets, its six cameras divided
//! between two fusion centres in every way in which two of them are shared.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::collections::{BTreeMap, BTreeSet};

use crossfix_fusion::{Fusion, FusionConfig, Neighbours, Output, Share};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Timestamp, Track, TrackFrame, TrackState, TruthFrame,
    decode,
};
use crossfix_tests::{messages, real_data, succeed};
use nalgebra::Point3;

/// The data set's cameras.
const CAMERAS: [&str; 6] = ["gopro3", "mate10", "mate7", "sony5100", "sony5n_1440x1080", "sonyG"];
/// A state that was said longer ago than this says nothing of now, s.
const FRESH_S: f64 = 0.6;

/// A fusion centre of some cameras, and what it says beside the other.
struct Centre {
    cameras: BTreeSet<&'static str>,
    fusion: Fusion,
    neighbours: Neighbours,
}

impl Centre {
    fn new(index: usize, cameras: &[usize], calibrations: &[CameraCalibration]) -> Self {
        let cameras: BTreeSet<&str> = cameras.iter().map(|camera| CAMERAS[*camera]).collect();
        let config = FusionConfig::default();
        let neighbours = Neighbours::new(Share { index, of: 2 }, &config);
        let mut fusion = Fusion::new(config).unwrap();
        for calibration in calibrations.iter().filter(|it| cameras.contains(it.camera.as_str())) {
            fusion.calibrate(calibration).unwrap();
        }
        Self { cameras, fusion, neighbours }
    }

    fn take(&mut self, frame: &BearingFrame) -> Vec<TrackFrame> {
        if !self.cameras.contains(frame.camera.as_str()) {
            return Vec::new();
        }
        let outputs = self.fusion.ingest(frame);
        let tracks =
            self.neighbours.forward(outputs).into_iter().filter_map(|output| match output {
                Output::Tracks(frame) => Some(frame),
                _ => None,
            });
        tracks.collect()
    }
}

/// What people know at one time: who said each sure number last, when, and what.
#[derive(Default)]
struct Known(BTreeMap<u64, (f64, usize, Track)>);

impl Known {
    fn receive(&mut self, who: usize, frame: &TrackFrame) {
        let seconds = Timestamp::from_nanos(frame.time_ns).seconds();
        for track in &frame.tracks {
            if track.state() == TrackState::Confirmed {
                self.0.insert(track.id, (seconds, who, track.clone()));
            } else {
                self.0.remove(&track.id);
            }
        }
    }

    fn at(&self, seconds: f64) -> Vec<(u64, usize, Point3<f64>)> {
        let fresh = self.0.iter().filter(|(_, (said, _, _))| seconds - said < FRESH_S);
        let place = |track: &Track, since_s: f64| {
            let velocity: nalgebra::Vector3<f64> = track.velocity.unwrap().into();
            Point3::from(track.position.unwrap()) + velocity * since_s
        };
        fresh.map(|(id, (said, who, track))| (*id, *who, place(track, seconds - said))).collect()
    }
}

/// What came of one way of dividing the cameras: of the instants of the truth at which a sure track
/// was said.
#[derive(Debug, Default)]
struct Outcome {
    said: usize,
    /// Under which number the nearest one was.
    numbers: BTreeMap<u64, usize>,
    /// By which centre.
    by: [usize; 2],
    /// Where more than one number was said.
    twice: usize,
    /// By the instant, the square of how far off it was, a metre at most: who is wrong is wrong.
    squares: BTreeMap<usize, f64>,
}

impl Outcome {
    /// The share that the commonest number has.
    fn commonest(&self) -> f64 {
        *self.numbers.values().max().unwrap() as f64 / self.said as f64
    }

    /// Mean square at some instants at which it said something.
    fn mean_square(&self, is_asked: impl Fn(&usize) -> bool) -> f64 {
        let asked = self.squares.iter().filter(|(instant, _)| is_asked(instant));
        let squares: Vec<f64> = asked.map(|(_, square)| *square).collect();
        squares.iter().sum::<f64>() / squares.len() as f64
    }
}

fn divided(
    areas: [&[usize]; 2],
    calibrations: &[CameraCalibration],
    frames: &[BearingFrame],
    truth: &[(f64, Point3<f64>)],
) -> Outcome {
    let mut centres = [0, 1].map(|index| Centre::new(index, areas[index], calibrations));
    let (mut known, mut outcome) = (Known::default(), Outcome::default());
    let mut next = 0;
    for frame in frames {
        let seconds = Timestamp::from_nanos(frame.capture_time_ns).seconds();
        for who in [0, 1] {
            for said in centres[who].take(frame) {
                known.receive(who, &said);
                centres[1 - who].neighbours.receive(who, &said);
            }
        }
        // What was said a tenth of a second ago has been handled by both.
        while truth.get(next).is_some_and(|(t, _)| t + 0.1 < seconds) {
            let (t, place) = truth[next];
            next += 1;
            let now = known.at(t);
            outcome.twice += usize::from(now.len() > 1);
            let Some((id, who, nearest)) = now
                .into_iter()
                .min_by(|a, b| (a.2 - place).norm().total_cmp(&(b.2 - place).norm()))
            else {
                continue;
            };
            outcome.said += 1;
            outcome.by[who] += 1;
            *outcome.numbers.entry(id).or_default() += 1;
            outcome.squares.insert(next, (nearest - place).norm().min(1.0).powi(2));
        }
    }
    outcome
}

/// The ways of giving two of six cameras to both areas and two to each alone.
fn ways() -> Vec<[Vec<usize>; 2]> {
    let mut ways = Vec::new();
    for code in 0..3_usize.pow(6) {
        let place: Vec<usize> = (0..6).map(|camera| code / 3_usize.pow(camera) % 3).collect();
        let of =
            |area: usize| (0..6).filter(|c| [area, 2].contains(&place[*c])).collect::<Vec<_>>();
        let areas = [of(0), of(1)];
        let shared = place.iter().filter(|area| **area == 2).count();
        if shared == 2 && areas[0].len() == 4 && areas[0] < areas[1] {
            ways.push(areas);
        }
    }
    ways
}

#[test]
fn a_real_drone_is_one_target_however_its_cameras_are_divided() {
    let Some(data) = real_data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let half = folder.path().join("half.mcap");
    let source = data.join("eth-multiview-drone").display().to_string();
    let names = CAMERAS.join(",");
    let arguments =
        ["import", "drone-tracking-datasets", &source, "--dataset", "3", "--cameras", &names];
    succeed(&[&arguments[..], &["-o", &half.display().to_string()]].concat());
    let calibrations: Vec<CameraCalibration> =
        messages(&half, |channel| matches!(channel, Channel::Calibration(_)))
            .iter()
            .map(|entry| decode(&entry.data).unwrap())
            .collect();
    let frames: Vec<BearingFrame> =
        messages(&half, |channel| matches!(channel, Channel::Bearings(_)))
            .iter()
            .map(|entry| decode(&entry.data).unwrap())
            .collect();
    let truth: Vec<(f64, Point3<f64>)> = messages(&half, |channel| *channel == Channel::Truth)
        .iter()
        .map(|entry| {
            let place = decode::<TruthFrame>(&entry.data).unwrap().targets[0].position.unwrap();
            (entry.data_time.seconds(), place.into())
        })
        .collect();
    let run = |areas: [&[usize]; 2]| divided(areas, &calibrations, &frames, &truth);
    for areas in ways().into_iter().step_by(6) {
        let [west, east] = [&areas[0], &areas[1]].map(|area| run([area, &[]]));
        let both = run([&areas[0], &areas[1]]);
        // At the same instants: where one says nothing the other has little to say.
        let says = |outcome: &Outcome, instant: &usize| outcome.squares.contains_key(instant);
        let all_say = |k: &usize| says(&west, k) && says(&east, k) && says(&both, k);
        let mean = |outcome: &Outcome| outcome.mean_square(all_say);
        // Where one of them alone says something, together they say it as well.
        let alone = |k: &usize| match (west.squares.get(k), east.squares.get(k)) {
            (Some(square), None) | (None, Some(square)) => Some(*square),
            _ => None,
        };
        let elsewhere: Vec<[f64; 2]> =
            both.squares.iter().filter_map(|(k, square)| Some([*square, alone(k)?])).collect();
        let [by_both, by_one] =
            [0, 1].map(|i| elsewhere.iter().map(|squares| squares[i]).sum::<f64>());
        println!(
            "{areas:?}: said {} times ({} and {} alone), one number {:.3} ({:.3} and {:.3}), two at once {}, \
             mean square {:.3} ({:.3} and {:.3} m^2), \
             where one alone says something {by_both:.1} m^2 ({by_one:.1}) in all",
            both.said,
            west.said,
            east.said,
            both.commonest(),
            west.commonest(),
            east.commonest(),
            both.twice,
            mean(&both),
            mean(&west),
            mean(&east)
        );
        assert!(both.said > west.said.max(east.said), "who sees it says it");
        assert!(both.commonest() > 0.97, "{:?}", both.numbers);
        assert!(both.by.iter().all(|said| *said > both.said / 20), "both say it: {:?}", both.by);
        assert!(both.twice < both.said / 30, "{}", both.twice);
        assert!(mean(&both) < mean(&west).max(mean(&east)), "no worse than the worse of the two");
        assert!(by_both < 1.1 * by_one, "no worse than the one that sees it alone");
    }
}
