use std::fmt;

use serde::Serialize;

/// The parts of a recording that could not be read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Damage {
    /// Number of damaged places.
    pub places: u64,
    /// Number of bytes of the file that were skipped.
    pub bytes: u64,
    /// Position of the first damaged place, bytes from the file's beginning.
    pub first_at: u64,
    /// What is wrong there.
    pub first: String,
}

impl Damage {
    /// Adds a damaged place to those known.
    pub(crate) fn note(known: &mut Option<Self>, at: u64, bytes: u64, what: &str) {
        let damage = known.get_or_insert_with(|| Self {
            places: 0,
            bytes: 0,
            first_at: at,
            first: what.to_owned(),
        });
        damage.places += 1;
        damage.bytes += bytes;
    }
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { places, bytes, first_at, first } = self;
        write!(f, "at byte {first_at}: {first}")?;
        if *bytes > 0 {
            write!(f, "; {bytes} bytes in {places} places are missing")?;
        }
        Ok(())
    }
}
