use std::collections::VecDeque;

use crossfix_message::{Timestamp, Track, TrackState};
use nalgebra::Point3;
use rerun::RecordingStream;

use crate::earth::Earth;
use crate::limiter::Limiter;
use crate::{ViewError, draw};

/// A trail is drawn whole each time, and is most of what fills a viewer's memory: with the rate the points of
/// each go, too.
const TRAIL_RATE_HZ: f64 = 7.5;
/// Points of a trail, at its rate: ten seconds.
const TRAIL_POINTS: usize = 75;
/// On the map a track's whole way is said each time; between two it goes less than a point of the screen.
const MAP_RATE_HZ: f64 = 2.0;

/// Where a track has been.
#[derive(Default)]
pub(crate) struct Trail {
    points: VecDeque<[f32; 3]>,
    limiter: Limiter,
}

impl Trail {
    /// Goes on to a track's present place and draws the way to it, if it is time to.
    pub(crate) fn go_on(
        &mut self,
        stream: &RecordingStream,
        earth: Option<&Earth>,
        track: &Track,
        place: Point3<f64>,
        time: Timestamp,
    ) -> Result<(), ViewError> {
        if !self.limiter.allows("trail", time, TRAIL_RATE_HZ) {
            return Ok(());
        }
        // How far away it is one camera alone does not see: its way would be a guess.
        if track.state() != TrackState::OneCamera {
            self.points.push_back(draw::f32s(&place.coords));
        }
        while self.points.len() > TRAIL_POINTS {
            self.points.pop_front();
        }
        let points = self.points.make_contiguous();
        draw::trail(stream, track, points)?;
        match earth {
            Some(earth) if self.limiter.allows("map", time, MAP_RATE_HZ) => {
                earth.track(stream, track, place, points)
            }
            _ => Ok(()),
        }
    }
}
