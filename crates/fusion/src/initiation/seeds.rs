//! Seeds: sets of lines of one period, one per camera, that may be one target's.

use std::collections::BTreeSet;
use std::f64::consts::PI;

use crossfix_filter::Gate;
use crossfix_geometry::Pose;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Point3, Vector3};

use super::passing::{Passing, Passings};
use super::rooted_lines::RootedLines;
use super::{NamedLine, lines_with_pose};
use crate::cameras::{Cameras, KnownCamera, Rooted};
use crate::evidence::BEYOND_DOUBT;
use crate::prediction::BearingPrediction;
use crate::spatial::{LineId, MapSolution, TYPICAL_SPEED, TimedLine, chi_square, map};
use crate::{Exposure, FusionConfig, Initiation};

/// Bounds on time and memory in one period, however much clutter there is.
struct SeedBounds {
    /// Lines of one camera that are tried as an addition to a pair, the best first. With half of it
    /// a camera whose line of the target is the third best is left out of its seed.
    branches: usize,
    /// Pairs of closely passing lines that are extended. Beyond it the pairs of cameras that look
    /// most nearly along one line are left out; with half of it that happens with fewer bearings.
    close_pairs: usize,
    /// Seeds after which no more pairs are tried: if many bearings are alike, every combination of
    /// them is as good as any other. Half of it is still five times as many as are kept.
    found: usize,
    /// Seeds that are kept, the likeliest ones. With half of it a target of the less likely half
    /// waits for the next period.
    kept: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: SeedBounds =
    SeedBounds { branches: 5, close_pairs: 20_000, found: 20_000, kept: 2_000 };

/// Lines that are part of a set of at least this many cameras need not be tried in other sets. With
/// half of it two lines that cross by chance keep the true set from being tried.
const SETTLED_CAMERAS: usize = 4;
/// The set gates are computed for sets of fewer cameras than this; larger sets pass. With half of
/// it sets of 32 cameras pass whatever their residuals are.
const GATED_CAMERAS: usize = 64;
/// Up to this distance from the nearest camera new targets are as dense as `birth_density_per_m3`
/// says, m: at a kilometre a small drone is one pixel of an ordinary camera (0.5 mrad). Beyond it
/// the density of those that are seen falls with the cube of the distance, so that each factor of
/// distance brings as many. With one density for all distances a site would expect thousands of
/// targets at 10 km, and lines that cross there by chance would pass for them. With half of it
/// targets at 3 km that hardly move when the cameras begin to look are found seconds later.
const DENSE_M: f64 = 1000.0;

/// A set of lines that may be one target's, with its solution.
#[derive(Clone, Debug)]
pub(crate) struct Seed {
    /// One line per camera, in order of time.
    pub(crate) lines: Vec<NamedLine>,
    /// Position and velocity at the newest line's time.
    pub(crate) solution: MapSolution,
    /// Log-likelihood ratio of a new target against clutter.
    pub(crate) score: f64,
}

impl Seed {
    pub(crate) fn time(&self) -> Option<Timestamp> {
        self.lines.iter().map(|(_, line)| line.time).max()
    }
}

/// The search for seeds.
#[derive(Clone, Debug)]
pub(crate) struct SeedFinder {
    initiation: Initiation,
    passings: Passings,
    detection_probability: f64,
    line_gate: Gate,
    /// Largest chi-square of n true lines at the gate's probability, indexed by n.
    set_gates: Vec<f64>,
    least_cameras: usize,
    least_score: f64,
    /// How much less likely (logarithm) a set may be than the best of those that share two lines.
    margin: f64,
}

/// The lines of a period, from which sets are grown.
struct Growing<'a> {
    exposures: &'a [&'a Exposure],
    /// The camera of each exposure.
    cameras: &'a [Option<&'a KnownCamera>],
    rooted_lines: Option<&'a RootedLines>,
    lines: &'a [Vec<NamedLine>],
}

/// A line of a period, by indices.
#[derive(Clone, Copy, Debug)]
struct LineIndex {
    /// Of its exposure in the period.
    exposure: usize,
    /// Of the line in that exposure.
    line: usize,
}

impl Growing<'_> {
    fn line(&self, at: LineIndex) -> &NamedLine {
        &self.lines[at.exposure][at.line]
    }

    /// Whether a line is to an object fixed in its camera's view.
    fn rooted(&self, at: LineIndex) -> Rooted {
        self.exposures[at.exposure].sightings[at.line].rooted
    }

    /// Whether lines of these cameras to what stands in their views may cross by chance.
    fn may_cross<'b>(&self, cameras: impl Iterator<Item = &'b CameraName>) -> bool {
        self.rooted_lines.is_none_or(|lines| lines.may_cross(cameras))
    }

    /// Whether a set may consist of lines to objects fixed in their cameras' views that cross by
    /// chance. As long as this is unknown of a line (its camera has only begun to look), two
    /// cameras are not enough and three must agree.
    fn may_be_rooted(&self, set: &[LineIndex]) -> bool {
        let rooted = || set.iter().map(|&at| self.rooted(at));
        let is_unknown = set.len() == 2 && rooted().any(|rooted| rooted == Rooted::Unknown);
        let stands = rooted().all(|rooted| rooted == Rooted::Yes);
        let cameras = set.iter().map(|at| &self.exposures[at.exposure].camera);
        is_unknown || (stands && self.may_cross(cameras))
    }
}

impl SeedFinder {
    /// A search for sets of at least two cameras with a log-likelihood ratio above `least_score`,
    /// but for those that others leave no doubt about.
    pub(crate) fn of_likely(config: &FusionConfig, least_score: f64) -> Self {
        Self { margin: BEYOND_DOUBT, ..Self::new(config, 2, least_score) }
    }

    /// A search for all sets of at least `least_cameras` cameras.
    pub(crate) fn of_all(config: &FusionConfig, least_cameras: usize) -> Self {
        Self::new(config, least_cameras, f64::NEG_INFINITY)
    }

    fn new(config: &FusionConfig, least_cameras: usize, least_score: f64) -> Self {
        let initiation = config.initiation.clone();
        let line_gate = Gate::with_probability(initiation.spatial_gate_probability);
        // 2 n coordinates and three terms of the velocity's prior, less six unknowns: 2 n - 3
        // degrees of freedom.
        let set_gates = (0..GATED_CAMERAS)
            .map(|n: usize| {
                chi_square(initiation.spatial_gate_probability, (2 * n).saturating_sub(3).max(1))
            })
            .collect();
        Self {
            passings: Passings::new(&initiation),
            initiation,
            detection_probability: config.tracking.detection_probability,
            line_gate,
            set_gates,
            least_cameras,
            least_score,
            margin: f64::INFINITY,
        }
    }

    /// The seeds of one period, the likeliest first; what stands in the views may be a target where
    /// `rooted_lines` say that they do not cross by chance. `is_held` tells of a line whether
    /// something that has been followed before goes on with it.
    pub(crate) fn find(
        &self,
        exposures: &[&Exposure],
        cameras: &Cameras,
        rooted_lines: Option<&RootedLines>,
        is_held: impl Fn(&LineId) -> bool,
    ) -> Vec<Seed> {
        let lines: Vec<Vec<NamedLine>> =
            exposures.iter().map(|e| lines_with_pose(e).collect()).collect();
        let cameras: Vec<Option<&KnownCamera>> =
            exposures.iter().map(|exposure| cameras.known(&exposure.camera)).collect();
        let growing = Growing { exposures, cameras: &cameras, rooted_lines, lines: &lines };
        let mut settled: Vec<Vec<bool>> = lines.iter().map(|l| vec![false; l.len()]).collect();
        let mut seeds = Vec::new();
        let mut close = 0;
        for [a, b] in self.pairs_of_cameras(&growing) {
            let pair = [a, b].map(|exposure| &exposures[exposure].camera);
            let may_cross = exposures.len() == 2 && growing.may_cross(pair.into_iter());
            for i in 0..lines[a].len() {
                for j in 0..lines[b].len() {
                    let enough = close > BOUNDS.close_pairs || seeds.len() > BOUNDS.found;
                    // A line on which four cameras agree needs no other set.
                    if settled[a][i] || settled[b][j] || enough {
                        continue;
                    }
                    let both =
                        [LineIndex { exposure: a, line: i }, LineIndex { exposure: b, line: j }];
                    let stand = both.iter().all(|&at| growing.rooted(at) == Rooted::Yes);
                    if stand && may_cross {
                        continue;
                    }
                    let [one, other] = both.map(|at| &growing.line(at).1);
                    if self.passings.of(one, other) != Passing::Close {
                        continue;
                    }
                    close += 1;
                    for (set, seed) in self.sets_of(&growing, both) {
                        if set.len() >= SETTLED_CAMERAS {
                            for LineIndex { exposure, line } in set {
                                settled[exposure][line] = true;
                            }
                        }
                        seeds.push(seed);
                    }
                }
            }
        }
        // Of three cameras two are more than the third; of more, three should agree.
        let of_three = lines.iter().filter(|lines| !lines.is_empty()).count() <= 3;
        best(seeds, |id| is_held(id) || !of_three)
    }

    /// Pairs of cameras within reach of each other that have lines, those whose optical axes cross
    /// most nearly at a right angle first (Klochko 2020, eq. 12).
    fn pairs_of_cameras(&self, growing: &Growing<'_>) -> Vec<[usize; 2]> {
        let camera = |i: usize| Some(&growing.cameras[i]?.camera);
        let mut pairs = Vec::new();
        for a in 0..growing.exposures.len() {
            for b in a + 1..growing.exposures.len() {
                let (Some(one), Some(other)) = (camera(a), camera(b)) else {
                    continue;
                };
                let (one, other) = (one.pose(), other.pose());
                let apart = (one.position() - other.position()).norm();
                let any = !growing.lines[a].is_empty() && !growing.lines[b].is_empty();
                if any && apart <= 2.0 * self.initiation.max_range_m {
                    // |a x b| = sin of the angle between the optical axes: the range's deviation
                    // goes with 1 / sin.
                    pairs.push((optical_axis(one).cross(&optical_axis(other)).norm(), [a, b]));
                }
            }
        }
        pairs.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        pairs.into_iter().map(|(_, pair)| pair).collect()
    }

    /// The seeds that grow from two lines, with their sets of lines, but for those that are less
    /// likely than the best of them by the margin.
    fn sets_of(&self, growing: &Growing<'_>, both: [LineIndex; 2]) -> Vec<(Vec<LineIndex>, Seed)> {
        let Some(pair) = self.solve(&both.map(|at| growing.line(at).1.clone())) else {
            return Vec::new();
        };
        let mut open = vec![(both.to_vec(), pair)];
        let mut branched = false;
        let others = |c: &usize| both.iter().all(|at| at.exposure != *c);
        for c in (0..growing.exposures.len()).filter(others) {
            let of_set = |(set, solution): &(Vec<_>, _)| self.near(growing, set, solution, c);
            let near: Vec<Vec<usize>> = open.iter().map(of_set).collect();
            // So it is with most cameras of a wide site: the sets stay as they are.
            if near.iter().all(Vec::is_empty) {
                continue;
            }
            let mut next = Vec::new();
            for ((set, solution), near) in open.into_iter().zip(near) {
                let most = if branched { 1 } else { BOUNDS.branches };
                for line in near.iter().take(most) {
                    let mut longer = set.clone();
                    longer.push(LineIndex { exposure: c, line: *line });
                    let timed: Vec<TimedLine> =
                        longer.iter().map(|&at| growing.line(at).1.clone()).collect();
                    if let Some(solution) =
                        self.solve(&timed).filter(|s| self.agrees(s, longer.len()))
                    {
                        next.push((longer, solution));
                    }
                }
                // Until the sets have branched, the camera may also have missed the target.
                // After the first branching only the nearest line of each camera is tried: the
                // number of sets grows no further.
                if !branched || near.is_empty() || next.is_empty() {
                    next.push((set, solution));
                }
            }
            branched |= next.len() > 1;
            open = next;
        }
        let seeds = open.into_iter().filter_map(|(set, solution)| {
            let seed = self.seed(growing, &set, solution)?;
            Some((set, seed))
        });
        let mut found: Vec<_> = seeds.collect();
        // All these sets share two lines, so that one of them at most is a target's: a set that is
        // far less likely than the best, as one that leaves out a camera whose line fits, is not.
        // The two lines alone may be all the same: where a third camera is turned, a great speed
        // explains its line too, and the set of three looks better than it is.
        let best = found.iter().map(|(_, seed)| seed.score).fold(f64::NEG_INFINITY, f64::max);
        found.retain(|(set, seed)| set.len() == 2 || seed.score > best - self.margin);
        found
    }

    fn solve(&self, lines: &[TimedLine]) -> Option<MapSolution> {
        let newest = lines.iter().map(|l| l.time).max()?;
        map(lines, newest, self.initiation.velocity_prior_sd_mps)
    }

    /// Whether the chi-square of a solution of n lines passes the gate: true sets do with the
    /// gate's probability.
    fn agrees(&self, solution: &MapSolution, lines: usize) -> bool {
        let gate = self.set_gates.get(lines).copied().unwrap_or(f64::INFINITY);
        solution.chi_square <= gate
    }

    /// The lines of exposure `c` in the gate of a set's solution, the nearest first.
    fn near(
        &self,
        growing: &Growing<'_>,
        set: &[LineIndex],
        solution: &MapSolution,
        c: usize,
    ) -> Vec<usize> {
        let known = growing.cameras[c];
        let newest = set.iter().map(|&at| growing.line(at).1.time).max();
        let (Some(known), Some(newest), Some((_, first))) =
            (known, newest, growing.lines[c].first())
        else {
            return Vec::new();
        };
        let state = solution.state.predicted(first.time.seconds_since(newest), 0.0);
        // Most cameras of a wide site do not look at this position.
        if !known.expects(state.position(), self.initiation.max_range_m) {
            return Vec::new();
        }
        // Displacement (m, standard deviation) by an uncertain time and an uncertain origin.
        let moved = self.initiation.velocity_prior_sd_mps * TYPICAL_SPEED * first.time_sd_s;
        let moved = moved.hypot(first.origin_sd_m);
        // Most lines pass the place by more than any gate holds, whichever way that is long: for
        // them alone nothing is predicted.
        let (place, origin) = (state.position(), first.line.origin);
        let spread = state.position_covariance().trace() + 2.0 * moved.powi(2);
        let range_squared = (place - origin).norm_squared();
        let may_fit = |(_, (_, timed)): &(usize, &NamedLine)| {
            let longest = spread + timed.line.covariance.trace() * range_squared;
            timed.line.miss_distance(place).powi(2) <= self.line_gate.threshold() * longest
        };
        let mut lines = growing.lines[c].iter().enumerate().filter(may_fit).peekable();
        if lines.peek().is_none() {
            return Vec::new();
        }
        let Some(prediction) = BearingPrediction::of_state(&state, origin, moved) else {
            return Vec::new();
        };
        let mut near: Vec<(f64, usize)> = Vec::new();
        for (l, (_, timed)) in lines {
            if let Some(fit) = prediction.fit(&timed.line, self.line_gate) {
                near.push((fit.gate_distance, l));
            }
        }
        near.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        near.into_iter().map(|(_, l)| l).collect()
    }

    /// The seed of a set, if it is consistent and likely enough.
    fn seed(
        &self,
        growing: &Growing<'_>,
        set: &[LineIndex],
        solution: MapSolution,
    ) -> Option<Seed> {
        if set.len() < self.least_cameras || growing.may_be_rooted(set) {
            return None;
        }
        let mut lines: Vec<NamedLine> = set.iter().map(|&at| growing.line(at).clone()).collect();
        lines.sort_by(|x, y| x.1.time.cmp(&y.1.time).then_with(|| x.0.cmp(&y.0)));
        let position = solution.state.position();
        let in_range =
            |(_, l): &NamedLine| (position - l.line.origin).norm() < self.initiation.max_range_m;
        if !(lines.iter().all(in_range) && self.agrees(&solution, lines.len())) {
            return None;
        }
        // Cameras that should have seen it and have no line of it: each counts ln(1 - P_D).
        let silent = self.silent_cameras(growing, set, position);
        let false_alarms: f64 =
            set.iter().map(|at| growing.exposures[at.exposure].clutter_per_sr.ln()).sum();
        let score = self.log_evidence(&lines, &solution)? - false_alarms
            + silent as f64 * (1.0 - self.detection_probability).ln();
        (score > self.least_score).then_some(Seed { lines, solution, score })
    }

    /// Number of cameras that should have seen a target at this position and have no line in the
    /// set.
    fn silent_cameras(
        &self,
        growing: &Growing<'_>,
        set: &[LineIndex],
        position: Point3<f64>,
    ) -> usize {
        let cameras = growing.cameras.iter().enumerate();
        let without = cameras.filter(|(k, _)| set.iter().all(|at| at.exposure != *k));
        let known = without.filter_map(|(_, known)| *known);
        known.filter(|known| known.expects(position, self.initiation.max_range_m)).count()
    }

    /// Logarithm of the probability density of the lines if they are a new target's: the density of
    /// new targets times the integral over all positions and velocities.
    fn log_evidence(&self, lines: &[NamedLine], solution: &MapSolution) -> Option<f64> {
        // Laplace's approximation: the integral of exp(-chi^2 / 2) over six unknowns is its maximum
        // times (2 pi)^3 |P|^(1/2). The velocity's prior divides by (2 pi)^(3/2) sd^3, which leaves
        // (2 pi)^(3/2) |P|^(1/2) / sd^3.
        let factor = solution.state.covariance.cholesky()?;
        let log_root: f64 = factor.l().diagonal().map(f64::ln).sum();
        let velocity = 3.0 * self.initiation.velocity_prior_sd_mps.ln();
        let ranges =
            lines.iter().map(|(_, timed)| (solution.state.position() - timed.line.origin).norm());
        let nearest = ranges.fold(f64::INFINITY, f64::min);
        // ln(density min(1, (D / r)^3)).
        let births =
            self.initiation.birth_density_per_m3.ln() + 3.0 * (DENSE_M / nearest).ln().min(0.0);
        let mut evidence =
            births + 1.5 * (2.0 * PI).ln() + log_root - velocity - solution.chi_square / 2.0;
        let (position, speed) = (solution.state.position(), self.initiation.velocity_prior_sd_mps);
        // Each line: detected, with the normal density's factor 1 / (2 pi |R|^(1/2)).
        for (_, timed) in lines {
            let noise = timed.noise_at((position - timed.line.origin).norm(), speed);
            let density = (2.0 * PI).ln() + noise.determinant().ln() / 2.0;
            evidence += self.detection_probability.ln() - density;
        }
        evidence.is_finite().then_some(evidence)
    }
}

/// The likeliest seeds, each set once.
fn best(seeds: Vec<Seed>, is_held: impl Fn(&LineId) -> bool) -> Vec<Seed> {
    // If cameras report the same bearings many times, many seeds are alike: the names are made
    // once.
    let names: Vec<Vec<LineId>> = seeds.iter().map(ids).collect();
    let mut order: Vec<usize> = (0..seeds.len()).collect();
    order.sort_by(|&a, &b| {
        seeds[b].score.total_cmp(&seeds[a].score).then_with(|| names[a].cmp(&names[b]))
    });
    let mut seen = BTreeSet::new();
    order.retain(|&i| seen.insert(&names[i]));
    // A pair whose two lines are both part of sets of three cameras, the same set or different
    // ones, can wait while what has been followed before holds these lines: there are many more
    // such pairs than targets. If nothing holds them, the sets may be wrong: where one of three
    // cameras is turned, a great speed explains its line in each period anew, and in no two.
    let agreed: BTreeSet<&LineId> =
        order.iter().map(|&i| &names[i]).filter(|names| names.len() > 2).flatten().collect();
    let may_wait = |i: &usize| {
        names[*i].len() == 2 && names[*i].iter().all(|id| agreed.contains(id) && is_held(id))
    };
    order.retain(|i| !may_wait(i));
    order.truncate(BOUNDS.kept);
    let mut seeds: Vec<Option<Seed>> = seeds.into_iter().map(Some).collect();
    order.into_iter().filter_map(|i| seeds[i].take()).collect()
}

fn optical_axis(pose: &Pose) -> Vector3<f64> {
    pose.rotation().matrix().column(2).into_owned()
}

fn ids(seed: &Seed) -> Vec<LineId> {
    seed.lines.iter().map(|(id, _)| id.clone()).collect()
}
