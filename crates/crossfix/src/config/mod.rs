//! Configuration files: read, checked and explained before anything starts.

mod file;

pub use file::{load, parse};
