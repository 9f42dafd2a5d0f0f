//! Scenes with flying targets and cameras that look at them: ground truth, rendered images, clocks
//! with offset and drift. The same scene and seed give the same images bit for bit. A [`Site`] has
//! many cameras and targets, and gives their bearings without images.
//!
//! ```
//! use crossfix_simulation::Scene;
//!
//! let scene: Scene = toml::from_str(include_str!("../../../configs/demo/scene.toml"))?;
//! let world = scene.build()?;
//! let truth = world.truth(3.0);
//! assert_eq!(truth.len(), 2);
//! let frame = world.camera("north").ok_or("no such camera")?.frame(30);
//! assert_eq!(frame.brightness.len(), 640 * 480);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod circuit;
mod clock;
mod clutter;
mod mount;
mod path;
mod render;
mod scene;
mod silhouette;
mod site;
mod sky;
mod world;

pub use clock::SimulatedClock;
pub use clutter::SceneClutter;
pub use mount::{MountState, SceneMount, SimulatedMount};
pub use path::FlightPath;
pub use render::RenderedFrame;
pub use scene::{Scene, SceneCamera, SceneError, SceneTarget};
pub use silhouette::{Silhouette, TEMPLATE_SIZES};
pub use site::{Layout, SimulatedSite, Site, SiteCamera, SiteExposure};
pub use world::{SimulatedCamera, TargetState, World};
