//! Whether the camera has been jerked: noticed at a tenth of the cost of a registration.

use crossfix_correlation::Plane;

use crate::coarse_picture::COARSENESS;
use crate::noise::median;

/// The change from one image to the next that shows that the camera is jerked.
struct Jerk {
    /// Factor above the usual change. With half of it every image is a jerk whose usual change
    /// exceeds a level.
    factor: f32,
    /// Levels above that. With half of it so is a flicker of an eighth of a level.
    levels: f32,
    /// Time constant of the running mean that is the usual change, s. With half of it a jerk counts
    /// twice as much in what is usual after it.
    usual_s: f64,
}

/// The numbers in use; what half of each does is said at its field.
const JERK: Jerk = Jerk { factor: 1.5, levels: 0.25, usual_s: 0.65 };

/// Of this many blocks of the coarse picture along a row one is compared: there are hundreds, and a
/// jerk has to change half of them. With half of it the glance costs twice as much and shows the
/// same.
const GLANCED: usize = 4;

/// One row of some blocks, by which a jerk of the camera is noticed at a tenth of the cost of a
/// registration.
#[derive(Debug, Default)]
pub(crate) struct RowGlance {
    /// Mean of one row of each of these blocks, in the last image.
    means: Vec<f32>,
    changes: Vec<f32>,
    /// Usual median change of these means from image to image, levels.
    usual: f32,
}

impl RowGlance {
    /// Whether most of the image has changed since the image before, by more than noise. True for
    /// the first image.
    pub(crate) fn is_another(&mut self, image: &Plane, interval: f64) -> bool {
        let Self { means, changes, usual } = self;
        let rows = (COARSENESS / 2..image.height()).step_by(COARSENESS);
        let blocks =
            rows.flat_map(|y| image.row(y).as_chunks::<COARSENESS>().0.iter().step_by(GLANCED));
        let now = blocks.map(|block| block.iter().sum::<f32>() / COARSENESS as f32);
        changes.clear();
        if means.is_empty() {
            means.extend(now);
            return true;
        }
        for (before, now) in means.iter_mut().zip(now) {
            let change = (now - *before).abs();
            *before = now;
            // Broken samples say nothing.
            if change.is_finite() {
                changes.push(change);
            }
        }
        // The median of the changes: targets change a few blocks, a jerk most of them.
        let change = median(changes);
        let most = JERK.factor * *usual + JERK.levels;
        // A jerk enters the usual change only as far as the threshold.
        let share = (1.0 - (-interval / JERK.usual_s).exp()) as f32;
        *usual += share * (change.min(most) - *usual);
        change > most
    }
}
