use std::fmt;

use serde::Serialize;

/// Drawn at random when a session opens: another number is another run of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(transparent)]
pub struct RunId(pub u64);

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

/// Who sent a message, and the how manieth it was on its key: goes beside the message, so that what
/// is lost on the way to one receiver is counted by that receiver, whatever the message is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin {
    /// The sender's run.
    pub run: RunId,
    /// Counts what that run published on the key, from 0.
    pub sequence: u64,
}

impl Origin {
    /// The run, then the sequence number, little end first.
    pub(crate) fn to_bytes(self) -> [u8; 16] {
        let mut bytes = [0; 16];
        bytes[..8].copy_from_slice(&self.run.0.to_le_bytes());
        bytes[8..].copy_from_slice(&self.sequence.to_le_bytes());
        bytes
    }

    /// `None` of what another program put there.
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
