use std::fmt;

use serde::Serialize;

/// Identifies a run of a program: drawn at random when a session opens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(transparent)]
pub struct RunId(pub u64);

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

/// The sender of a message and the message's number on its key. It travels beside the message, so
/// that each receiver can count what it lost, whatever the message is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin {
    /// The sender's run.
    pub run: RunId,
    /// Number of the message among those that the run published on the key, from 0.
    pub sequence: u64,
}

impl Origin {
    /// The run, then the sequence number, little-endian.
    pub(crate) fn to_bytes(self) -> [u8; 16] {
        let mut bytes = [0; 16];
        bytes[..8].copy_from_slice(&self.run.0.to_le_bytes());
        bytes[8..].copy_from_slice(&self.sequence.to_le_bytes());
        bytes
    }

    /// Reads an origin; `None` if the bytes are another program's.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (run, sequence) = bytes.split_first_chunk::<8>()?;
        let sequence: [u8; 8] = sequence.try_into().ok()?;
        Some(Self { run: RunId(u64::from_le_bytes(*run)), sequence: u64::from_le_bytes(sequence) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_survives_its_bytes_and_others_are_none() {
        let origin = Origin { run: RunId(7), sequence: u64::MAX };
        assert_eq!(Origin::from_bytes(&origin.to_bytes()), Some(origin));
        assert_eq!(Origin::from_bytes(b"somebody else's"), None);
    }
}
