//! Readers of published data sets.

pub mod drone_tracking;
pub mod scenario;
