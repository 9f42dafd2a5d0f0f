use std::collections::BTreeMap;
use std::time::Duration;

use crossfix_geometry::{Camera, Geodetic};
use crossfix_message::{
    BearingFrame, Calibration, CameraCalibration, Channel, DecodeError, Health, ImageTrackState,
    Preview, Timestamp, Track, TrackEvent, TrackFrame, TrackState, TruthFrame, decode,
};
use nalgebra::{Point3, Vector3};
use rerun::RecordingStream;
use rerun_types::archetypes::{Clear, EncodedImage, Points3D, Scalars, TextLog, ViewCoordinates};
use rerun_types::components::{Color, MediaType, Radius, TextLogLevel};

use crate::arrivals::FrameArrivals;
use crate::earth::{Earth, GroundPicture};
use crate::extent::BoundingBox;
use crate::image::{self, Ring, TargetRegion};
use crate::limiter::Limiter;
use crate::paths::{TIMELINE, image_path};
use crate::trail::Trail;
use crate::{ViewError, ViewerWatch, blueprint, colour, draw, ground, legend};

/// Most drawings per second of a camera's previews. With half of it they jerk; with twice as much
/// the viewer's memory, most of which is images, lasts half as long.
const PREVIEW_RATE_HZ: f64 = 5.0;
/// Most drawings per second of a camera's sight lines. With half of it they lag behind the tracks.
const LINE_RATE_HZ: f64 = 10.0;
/// Most drawings per second of a track. With half of it it jerks; with twice as much it takes twice
/// the viewer's memory.
const TRACK_RATE_HZ: f64 = 15.0;
/// Most fusion centres whose problems are remembered. Those of one more are written again with each
/// of its reports; with half of it, from the 501st on.
const MOST_CENTRES: usize = 1000;
/// Length of sight lines as long as no track shows how far they should reach, m. With half of it
/// the lines of cameras 200 m apart do not cross.
const DEFAULT_REACH_M: f64 = 150.0;
/// Height above the cameras where targets are expected, as long as no track shows them, m. With
/// half of it the first track may begin outside of the view, which is then laid out again.
const AIR_M: f64 = 25.0;
/// A track of which no message came for this long is removed, s: each is sent twice a second, so
/// its fusion centre is gone. With half of it tracks vanish where a link stalls for two seconds.
const GHOST_S: f64 = 3.0;

/// The picture is laid out about tracks with a smaller standard deviation than this, m: one that is
/// far off must not make all others small. With half of it a distant track that is known to 3 m may
/// lie outside of the view.
const LAID_OUT_SD_M: f64 = 5.0;

/// The part of the cameras' images that is shown.
#[derive(Clone, Copy, Debug)]
enum Shown {
    /// Whole images: while messages still come, it is not known where targets will be.
    WholeImages,
    /// The parts in which targets were seen.
    WhereTargetsWere,
}

struct CameraView {
    index: u64,
    calibration: Calibration,
    /// The camera as it points now: on a mount, as its last frame said.
    camera: Camera,
    scale: f64,
    /// Hash of the calibration that is drawn.
    hash: Vec<u8>,
    /// The part of its images in which targets were seen.
    region: Option<TargetRegion>,
}

impl CameraView {
    /// Low and high corner of the part of its images to show; `None` for all of them.
    fn part(&self, shown: Shown) -> Option<[[f64; 2]; 2]> {
        match shown {
            Shown::WholeImages => None,
            Shown::WhereTargetsWere => {
                self.region.map(|region| region.shown(&self.camera, self.scale))
            }
        }
    }

    /// Turns a camera on a mount to the pointing that a frame states.
    fn point(&mut self, stream: &RecordingStream, frame: &BearingFrame) -> Result<(), ViewError> {
        if self.calibration.mount.is_none() {
            return Ok(());
        }
        // A frame without a usable pointing is reported by the fusion.
        let Some(pointed) = self.calibration.pointed(frame.pointing.as_ref()) else {
            return Ok(());
        };
        self.camera = pointed;
        draw::turned_pose(stream, &frame.camera, &self.camera)
    }
}

/// A track as it was drawn last.
struct DrawnTrack {
    track: Track,
    time: Timestamp,
    place: Point3<f64>,
    /// Arrival of the last message about it.
    arrival: Timestamp,
}

/// Draws a site's messages.
pub struct SitePicture {
    stream: RecordingStream,
    cameras: BTreeMap<String, CameraView>,
    trails: BTreeMap<u64, Trail>,
    drawn: BTreeMap<u64, DrawnTrack>,
    limiter: Limiter,
    arrivals: FrameArrivals,
    viewer: ViewerWatch,
    earth: Option<Earth>,
    /// Extent of where confirmed tracks have been.
    flown: BoundingBox,
    /// The problems that each fusion centre reported last.
    problems: BTreeMap<String, Vec<String>>,
}

impl SitePicture {
    /// An empty picture on a stream of [`crate::save`] or [`crate::connect`].
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn new(stream: RecordingStream) -> Result<Self, ViewError> {
        stream.set_log_time_enabled(false);
        stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        legend::draw(&stream)?;
        Ok(Self {
            stream,
            cameras: BTreeMap::new(),
            trails: BTreeMap::new(),
            drawn: BTreeMap::new(),
            limiter: Limiter::default(),
            arrivals: FrameArrivals::default(),
            viewer: ViewerWatch::default(),
            earth: None,
            flown: BoundingBox::default(),
            problems: BTreeMap::new(),
        })
    }

    /// Adds a map beside the site, whose origin is at the anchor, and a picture of the ground under
    /// it.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn on_earth(
        self,
        anchor: Geodetic,
        ground: Option<GroundPicture>,
    ) -> Result<Self, ViewError> {
        let earth = Earth::new(&self.stream, anchor, ground)?;
        Ok(Self { earth: Some(earth), ..self })
    }

    /// Draws a message that arrived at `arrival`. One that cannot be read is left out, and its
    /// error returned.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn show(
        &mut self,
        channel: &Channel,
        arrival: Timestamp,
        data: &[u8],
    ) -> Result<Option<DecodeError>, ViewError> {
        let read = match channel {
            Channel::Calibration(_) => decode(data).map(|m| self.calibration(&m)),
            Channel::Preview(_) => decode(data).map(|m| self.preview(&m)),
            Channel::Bearings(_) => decode(data).map(|m| self.bearings(&m, arrival)),
            Channel::Tracks => decode(data).map(|m| self.tracks(&m, arrival)),
            Channel::Events => decode(data).map(|m| self.event(&m)),
            Channel::Truth => decode(data).map(|m| self.truth(&m)),
            Channel::FusionHealth => decode(data).map(|m| self.health(&m)),
            _ => return Ok(None),
        };
        match read {
            Ok(drawn) => drawn.map(|()| None),
            Err(error) => Ok(Some(error)),
        }
    }

    /// Lays the picture out again about all that it shows, and waits until everything is drawn.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn finish(self) -> Result<(), ViewError> {
        self.lay_out(Shown::WhereTargetsWere)?;
        self.stream.flush_blocking().map_err(|error| ViewError::Flush(error.to_string()))
    }

    /// Waits until everything is drawn, for `patience` at most, as a viewer that takes nothing must
    /// not hold us up.
    ///
    /// # Errors
    /// [`ViewError::Flush`].
    pub fn finish_within(self, patience: Duration) -> Result<(), ViewError> {
        self.stream
            .flush_with_timeout(patience)
            .map_err(|error| ViewError::Flush(error.to_string()))
    }

    /// Whether the viewer is gone for good; meant to be asked about once a second.
    pub fn has_lost_its_viewer(&self) -> bool {
        self.viewer.check(&self.stream);
        self.viewer.is_gone()
    }

    fn at(&self, time_ns: i64) -> Timestamp {
        self.stream.set_timestamp_nanos_since_epoch(TIMELINE, time_ns);
        Timestamp::from_nanos(time_ns)
    }

    fn calibration(&mut self, message: &CameraCalibration) -> Result<(), ViewError> {
        // An invalid calibration is reported by the fusion.
        let Ok(parsed) = message.parse() else {
            return Ok(());
        };
        let name = parsed.name.to_string();
        let known = self.cameras.len() as u64;
        let new = !self.cameras.contains_key(&name);
        let view = self.cameras.entry(name.clone()).or_insert(CameraView {
            index: known,
            camera: parsed.camera.clone(),
            calibration: parsed.clone(),
            scale: 1.0,
            hash: Vec::new(),
            region: None,
        });
        if new || view.hash != message.hash {
            view.hash.clone_from(&message.hash);
            view.camera = parsed.camera.clone();
            if parsed.mount.is_none() {
                draw::fixed_pose(&self.stream, &name, &view.camera)?;
            }
            view.calibration = parsed;
            draw::camera(&self.stream, &name, view.index, &view.camera, view.scale)?;
            draw::residual_plot(&self.stream, &name, view.index)?;
            if let Some(earth) = &self.earth {
                let place = view.camera.pose().position();
                earth.camera(&self.stream, &name, place, colour::of(view.index))?;
            }
            self.lay_out(Shown::WholeImages)?;
        }
        Ok(())
    }

    /// Lays the picture out about the cameras and tracks known so far.
    fn lay_out(&self, shown: Shown) -> Result<(), ViewError> {
        let mut extent =
            BoundingBox::of(self.cameras.values().map(|view| view.camera.pose().position()));
        if self.flown.is_empty() {
            // No track yet: includes the air where targets are likely to be.
            extent.include(extent.middle() + Vector3::z() * AIR_M);
        } else {
            self.flown.corners().for_each(|corner| extent.include(corner));
        }
        ground::draw(&self.stream, &extent)?;
        if let Some(earth) = &self.earth {
            earth.ground(&self.stream, &extent)?;
        }
        let cameras: Vec<blueprint::CameraPanel> = self
            .cameras
            .iter()
            .map(|(name, view)| blueprint::CameraPanel {
                name: name.clone(),
                shown: view.part(shown),
            })
            .collect();
        blueprint::send(&self.stream, &cameras, &extent, self.earth.as_ref())
    }

    fn preview(&mut self, preview: &Preview) -> Result<(), ViewError> {
        let time = self.at(preview.capture_time_ns);
        let path = image_path(&preview.camera);
        if !self.limiter.allows(&path, time, PREVIEW_RATE_HZ) {
            return Ok(());
        }
        if let Some(view) = self.cameras.get_mut(&preview.camera)
            && preview.scale > 0.0
            && view.scale != preview.scale
        {
            view.scale = preview.scale;
            draw::camera(&self.stream, &preview.camera, view.index, &view.camera, view.scale)?;
        }
        let image = EncodedImage::new(preview.data.clone()).with_media_type(MediaType::jpeg());
        Ok(self.stream.log(path, &image)?)
    }

    fn bearings(&mut self, frame: &BearingFrame, arrival: Timestamp) -> Result<(), ViewError> {
        self.arrivals.note(&frame.camera, frame.sequence, arrival);
        self.clear_ghosts(arrival, Timestamp::from_nanos(frame.capture_time_ns))?;
        let time = self.at(frame.capture_time_ns);
        let Some(view) = self.cameras.get_mut(&frame.camera) else {
            return Ok(());
        };
        if !self.limiter.allows(&format!("lines/{}", frame.camera), time, LINE_RATE_HZ) {
            return Ok(());
        }
        view.point(&self.stream, frame)?;
        // A little farther than the farthest track, so that the crossings of sight lines are seen.
        let origin = view.camera.pose().position();
        let placed =
            self.drawn.values().filter(|drawn| drawn.track.state() != TrackState::OneCamera);
        let farthest = placed.map(|drawn| (drawn.place - origin).norm()).fold(0.0, f64::max);
        let reach = if farthest > 0.0 { 1.1 * farthest } else { DEFAULT_REACH_M };
        let seen = frame.tracks.iter().filter(|track| track.state() == ImageTrackState::Tracking);
        seen.for_each(|track| {
            TargetRegion::include(&mut view.region, [track.pixel_x, track.pixel_y]);
        });
        draw::bearings(&self.stream, frame, view.index, &view.camera, reach)?;
        image::boxes(&self.stream, &frame.camera, view.index, &frame.tracks, view.scale)
    }

    fn tracks(&mut self, frame: &TrackFrame, arrival: Timestamp) -> Result<(), ViewError> {
        let time = self.at(frame.time_ns);
        self.plots(frame, arrival, time)?;
        let ended: Vec<u64> = frame
            .tracks
            .iter()
            .filter(|track| track.state() == TrackState::Lost)
            .map(|track| track.id)
            .collect();
        for id in ended {
            self.clear(id)?;
        }
        for track in frame.tracks.iter().filter(|track| track.state() != TrackState::Lost) {
            let Some(position) = track.position else {
                continue;
            };
            let drawn = self.drawn.get_mut(&track.id);
            let since = drawn.map(|drawn| {
                drawn.arrival = arrival;
                time.seconds_since(drawn.time)
            });
            if since.is_some_and(|since| (0.0..TRACK_RATE_HZ.recip()).contains(&since)) {
                continue;
            }
            let place = Point3::from(position);
            draw::track(&self.stream, track)?;
            let trail = self.trails.entry(track.id).or_default();
            trail.go_on(&self.stream, self.earth.as_ref(), track, place, time)?;
            self.drawn.insert(track.id, DrawnTrack { track: track.clone(), time, place, arrival });
            let is_sure = draw::position_sd(track) < LAID_OUT_SD_M;
            if track.state() == TrackState::Confirmed && is_sure {
                let is_first = self.flown.is_empty();
                self.flown.include(place);
                if is_first {
                    self.lay_out(Shown::WholeImages)?;
                }
            }
        }
        if self.limiter.allows("rings", time, LINE_RATE_HZ) {
            self.rings()?;
        }
        Ok(())
    }

    /// Draws the rings where each camera should see the tracks.
    fn rings(&self) -> Result<(), ViewError> {
        for (name, view) in &self.cameras {
            let ring = |drawn: &DrawnTrack| Ring::of(&drawn.track, drawn.place, &view.camera);
            let rings: Vec<Ring> = self.drawn.values().filter_map(ring).collect();
            image::rings(&self.stream, name, &rings, view.scale)?;
        }
        Ok(())
    }

    /// Removes tracks of which no message comes any more while bearings still do. They must be
    /// old both by arrival, as one camera's clock may be wrong, and by data time, as a recording's
    /// tracks may have been made long after its bearings.
    fn clear_ghosts(&mut self, arrival: Timestamp, time: Timestamp) -> Result<(), ViewError> {
        self.clear_if(|drawn| {
            arrival.seconds_since(drawn.arrival) > GHOST_S
                && time.seconds_since(drawn.time) > GHOST_S
        })
    }

    /// Removes tracks of which no message came for a while, in a live picture that may receive
    /// nothing at all any more; `now` is read from the clock of the arrivals.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn clear_silent(&mut self, now: Timestamp) -> Result<(), ViewError> {
        self.clear_if(|drawn| now.seconds_since(drawn.arrival) > GHOST_S)
    }

    fn clear_if(&mut self, is_gone: impl Fn(&DrawnTrack) -> bool) -> Result<(), ViewError> {
        let gone: Vec<u64> =
            self.drawn.iter().filter(|(_, drawn)| is_gone(drawn)).map(|(&id, _)| id).collect();
        gone.into_iter().try_for_each(|id| self.clear(id))
    }

    fn clear(&mut self, id: u64) -> Result<(), ViewError> {
        self.trails.remove(&id);
        if self.drawn.remove(&id).is_some() {
            self.stream.log(format!("world/tracks/{id}"), &Clear::recursive())?;
            if let Some(earth) = &self.earth {
                earth.clear(&self.stream, id)?;
            }
            self.rings()?;
        }
        Ok(())
    }

    fn plots(
        &mut self,
        frame: &TrackFrame,
        arrival: Timestamp,
        time: Timestamp,
    ) -> Result<(), ViewError> {
        if let Some(bearing) = self.arrivals.take(&frame.camera, frame.camera_sequence) {
            let latency = arrival.seconds_since(bearing) * 1e3;
            if latency > 0.0 && self.limiter.allows("latency", time, LINE_RATE_HZ) {
                self.stream.log("plots/latency", &Scalars::single(latency))?;
            }
        }
        if !self.limiter.allows(&format!("residual/{}", frame.camera), time, LINE_RATE_HZ) {
            return Ok(());
        }
        let residuals = frame.tracks.iter().flat_map(|track| &track.residuals);
        let angle = residuals
            .filter(|residual| residual.camera == frame.camera && residual.time_ns == frame.time_ns)
            .map(|residual| residual.angle_rad * 1e3)
            .fold(None, |most: Option<f64>, angle| Some(most.map_or(angle, |m| m.max(angle))));
        if let Some(angle) = angle {
            self.stream.log(format!("plots/residual/{}", frame.camera), &Scalars::single(angle))?;
        }
        Ok(())
    }

    fn event(&mut self, event: &TrackEvent) -> Result<(), ViewError> {
        self.at(event.time_ns);
        let text = event.to_string();
        Ok(self.stream.log("events", &TextLog::new(text))?)
    }

    /// Draws the problems of a fusion centre that a person should see to, when they begin.
    fn health(&mut self, health: &Health) -> Result<(), ViewError> {
        if health.time_ns == 0 {
            return Ok(());
        }
        self.at(health.time_ns);
        let known = self.problems.get(&health.component);
        let is_new = |problem: &&String| known.is_none_or(|known| !known.contains(problem));
        for problem in health.problems.iter().filter(is_new) {
            self.stream
                .log("events", &TextLog::new(problem.as_str()).with_level(TextLogLevel::WARN))?;
        }
        if known.is_some() || self.problems.len() < MOST_CENTRES {
            self.problems.insert(health.component.clone(), health.problems.clone());
        }
        Ok(())
    }

    fn truth(&mut self, frame: &TruthFrame) -> Result<(), ViewError> {
        let time = self.at(frame.time_ns);
        if !self.limiter.allows("truth", time, LINE_RATE_HZ) {
            return Ok(());
        }
        let places = frame.targets.iter().filter_map(|target| target.position);
        let points: Vec<[f32; 3]> = places.map(|p| [p.x as f32, p.y as f32, p.z as f32]).collect();
        let truth = Points3D::new(points)
            .with_colors([Color::from_rgb(255, 255, 255)])
            .with_radii([Radius::new_ui_points(2.5)]);
        Ok(self.stream.log("world/truth", &truth)?)
    }
}

#[cfg(test)]
mod tests;
