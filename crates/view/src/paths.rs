//! Entity paths and timeline names in Rerun.

/// The timeline of capture time.
pub(crate) const TIMELINE: &str = "capture_time";

/// The entity path of a camera's image.
pub(crate) fn image_path(name: &str) -> String {
    format!("world/cameras/{name}/image")
}
