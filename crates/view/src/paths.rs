//! Names in the picture.

/// The timeline of capture time.
pub(crate) const TIMELINE: &str = "capture_time";

/// The place of a camera's image.
pub(crate) fn image_path(name: &str) -> String {
    format!("world/cameras/{name}/image")
}
