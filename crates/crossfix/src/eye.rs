//! From a camera's frame to the message that says what it saw: the agent's
//! pure part, shared by `agent` and `track`.

use crossfix_correlation::Plane;
use crossfix_video::Frame;

/// The brightness of a frame as the tracker takes it; `None` for a frame without pixels.
pub fn brightness(frame: &Frame) -> Option<Plane> {
    Plane::new(frame.width, frame.height, frame.brightness())
}
