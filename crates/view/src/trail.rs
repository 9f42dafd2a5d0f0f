use std::collections::VecDeque;

use crossfix_message::{Timestamp, Track, TrackState};
use nalgebra::Point3;
use rerun::RecordingStream;

use crate::earth::Earth;
use crate::limiter::Limiter;
use crate::{ViewError, draw};

/// Rate at which a trail is drawn, Hz. Each time it is drawn whole, which is most of what fills a
/// viewer's memory; a lower rate also means fewer points per trail. With half of it a trail has a
/// corner every 8 m at 30 m/s.
const TRAIL_RATE_HZ: f64 = 7.5;
/// Points of a trail: ten seconds at its rate. With half of it, five; with twice as many a trail
/// takes twice the viewer's memory.
const TRAIL_POINTS: usize = 75;
/// Rate at which a track's whole trail is drawn on the map, Hz; between two drawings a track moves
/// by less than a point of the screen. With half of it it jumps by a point or two.
const MAP_RATE_HZ: f64 = 2.0;

/// The trail of a track.
#[derive(Default)]
pub(crate) struct Trail {
    points: VecDeque<[f32; 3]>,
    limiter: Limiter,
}

impl Trail {
    /// Adds a track's present place and draws the trail, if that is due.
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
        // One camera alone does not measure the range: its trail would be a guess.
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
