//! Feeds a file of cameras, frames and bearings to the fusion, and writes all that it says.
//!
//! ```text
//! scene FRAMES.txt OUT.txt [section.key=value ...]
//! ```
//!
//! FRAMES.txt has a line each: `C name width height focal R11..R33 x y z rotation_sd_rad
//! position_sd_m` (a camera: world from camera, optical axes, metres; both deviations 0: nobody has
//! declared them), `F name sequence time_ns time_sd_s` (a frame, in the order of arrival), `B ux uy
//! uz sigma_rad` (its bearings, camera frame). OUT.txt: `T time_ns id state x y z vx vy vz
//! covariance(36) frame_index rank condition`, `E time_ns kind id`, `S frame_index camera
//! standing`, then `R` what was refused, `N` the counters, `K` the cameras and `B` what it cost.

#![allow(clippy::print_stderr)]

use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::process::ExitCode;
use std::str::FromStr;
use std::time::Instant;

use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose};
use crossfix_message::{BearingFrame, BearingTrack, CameraCalibration, ImageTrackState, Timestamp};
use nalgebra::{Matrix3, Point3, Vector3};

type Failure = Box<dyn Error>;

/// One line of the file, word by word.
struct Words<'a>(Vec<&'a str>);

impl Words<'_> {
    fn at<T: FromStr>(&self, index: usize) -> Result<T, Failure>
    where
        T::Err: Error + 'static,
    {
        let word = self.0.get(index).ok_or("a line is too short")?;
        Ok(word.parse()?)
    }
}

/// The default configuration with some values (TOML) in place of the defaults.
fn configured(settings: &[String]) -> Result<FusionConfig, Failure> {
    let mut table = toml::Table::try_from(FusionConfig::default())?;
    for setting in settings {
        let (path, value) = setting.split_once('=').ok_or("a setting is section.key=value")?;
        let (section, key) = path.split_once('.').ok_or("a setting is section.key=value")?;
        let parsed: toml::Table = format!("value = {value}").parse()?;
        let section =
            table.get_mut(section).and_then(toml::Value::as_table_mut).ok_or("no such section")?;
        section.insert(key.to_owned(), parsed["value"].clone());
    }
    Ok(table.try_into()?)
}

fn calibration(words: &Words<'_>) -> Result<CameraCalibration, Failure> {
    let rotation = (5..14).map(|i| words.at(i)).collect::<Result<Vec<f64>, _>>()?;
    let place = Point3::new(words.at(14)?, words.at(15)?, words.at(16)?);
    let (width, height): (u32, u32) = (words.at(2)?, words.at(3)?);
    let focal = words.at(4)?;
    let lens = Intrinsics {
        size: ImageSize { width, height },
        fx: focal,
        fy: focal,
        cx: (f64::from(width) - 1.0) / 2.0,
        cy: (f64::from(height) - 1.0) / 2.0,
        distortion: Distortion::None,
    };
    let camera = Camera::new(lens, Pose::new(Matrix3::from_row_slice(&rotation), place)?)?;
    let message = CameraCalibration::new(&words.at(1)?, &camera, Timestamp::EPOCH);
    let (rotation_sd, position_sd): (f64, f64) = (words.at(17)?, words.at(18)?);
    let is_declared = rotation_sd > 0.0 || position_sd > 0.0;
    Ok(if is_declared { message.with_pose_sd(rotation_sd, position_sd) } else { message })
}

fn bearing(words: &Words<'_>, number: usize) -> Result<BearingTrack, Failure> {
    let direction = Vector3::new(words.at(1)?, words.at(2)?, words.at(3)?).normalize();
    let variance = words.at::<f64>(4)?.powi(2);
    Ok(BearingTrack {
        track_id: number as u64,
        bearing: Some(direction.into()),
        covariance_xx: variance,
        covariance_yy: variance,
        state: ImageTrackState::Tracking.into(),
        score: 1.0,
        ..Default::default()
    })
}

/// What the fusion costs and says.
struct Run {
    fusion: Fusion,
    out: BufWriter<File>,
    frames: usize,
    busy_s: f64,
    longest_s: f64,
    refused: BTreeMap<String, u64>,
}

impl Run {
    fn feed(&mut self, frame: &BearingFrame) -> Result<(), Failure> {
        let start = Instant::now();
        let outputs = self.fusion.ingest(frame);
        let took_s = start.elapsed().as_secs_f64();
        self.busy_s += took_s;
        self.longest_s = self.longest_s.max(took_s);
        self.write(outputs)?;
        self.frames += 1;
        Ok(())
    }

    fn write(&mut self, outputs: Vec<Output>) -> Result<(), Failure> {
        let (out, index) = (&mut self.out, self.frames);
        for output in outputs {
            match output {
                Output::Tracks(frame) => {
                    for track in &frame.tracks {
                        let (Some(p), Some(v)) = (track.position, track.velocity) else {
                            continue;
                        };
                        write!(out, "T {} {} {}", frame.time_ns, track.id, track.state)?;
                        write!(out, " {} {} {} {} {} {}", p.x, p.y, p.z, v.x, v.y, v.z)?;
                        for value in &track.covariance {
                            write!(out, " {value:e}")?;
                        }
                        writeln!(out, " {index} {} {}", track.rank, track.condition_number)?;
                    }
                }
                Output::Event(event) => {
                    writeln!(
                        out,
                        "E {} {} {}",
                        event.time_ns,
                        event.kind().as_str_name(),
                        event.track_id
                    )?;
                }
                Output::Rejected(rejection) => {
                    let kind = format!("{} {}", rejection.camera, rejection.reason.counter());
                    *self.refused.entry(kind).or_default() += 1;
                }
                Output::Camera(camera, standing) => {
                    writeln!(out, "S {index} {camera} {standing:?}")?;
                }
                // Asked for by no scene.
                Output::Smoothed(_) | Output::Cues(_) => {}
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<(), Failure> {
        let outputs = self.fusion.flush();
        self.write(outputs)?;
        let Self { fusion, mut out, frames, busy_s, longest_s, refused } = self;
        for (kind, count) in &refused {
            writeln!(out, "R {kind} {count}")?;
        }
        for (name, count) in fusion.counters().iter() {
            writeln!(out, "N {name} {count}")?;
        }
        for report in fusion.cameras() {
            let clock = report.clock.map(|c| (c.offset_s, c.sd_s, c.relative_sd_s, c.drift));
            let (camera, standing) = (report.camera, report.standing);
            writeln!(out, "K {camera} {standing:?} {} {clock:?}", report.noise_factor)?;
        }
        let mean_us = busy_s * 1e6 / frames.max(1) as f64;
        writeln!(out, "B us_per_frame {mean_us} max_ms {} frames {frames}", longest_s * 1e3)?;
        Ok(())
    }
}

fn run(arguments: &[String]) -> Result<(), Failure> {
    let [frames, out, settings @ ..] = arguments else {
        return Err("scene FRAMES.txt OUT.txt [section.key=value ...]".into());
    };
    let mut run = Run {
        fusion: Fusion::new(configured(settings)?)?,
        out: BufWriter::new(File::create(out)?),
        frames: 0,
        busy_s: 0.0,
        longest_s: 0.0,
        refused: BTreeMap::new(),
    };
    let mut pending: Option<BearingFrame> = None;
    for line in BufReader::new(File::open(frames)?).lines() {
        let line = line?;
        let words = Words(line.split(' ').collect());
        match words.0[0] {
            "C" => run.fusion.calibrate(&calibration(&words)?)?,
            "F" => {
                if let Some(frame) = pending.take() {
                    run.feed(&frame)?;
                }
                pending = Some(BearingFrame {
                    camera: words.at(1)?,
                    sequence: words.at(2)?,
                    capture_time_ns: words.at(3)?,
                    capture_time_sd_s: words.at(4)?,
                    ..Default::default()
                });
            }
            "B" => {
                if let Some(frame) = &mut pending {
                    frame.tracks.push(bearing(&words, frame.tracks.len())?);
                }
            }
            _ => {}
        }
    }
    if let Some(frame) = pending {
        run.feed(&frame)?;
    }
    run.finish()
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
