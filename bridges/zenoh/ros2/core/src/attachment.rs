//! The attachment of each put, request and reply: 33 bytes.

use std::fmt;

/// Bytes of an identity.
const GID: usize = 16;
/// Number, time, length of the identity, identity.
const LENGTH: usize = 8 + 8 + 1 + GID;

/// The attachment that `rmw_zenoh` has for each put: a number, a time and the identity of the sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// The number of the message at its sender. A reply has that of its request.
    pub sequence: i64,
    /// When it was sent, in nanoseconds of the wall clock of the sender's host.
    pub time_ns: i64,
    /// The identity of the publisher, or of the client of a service.
    pub gid: [u8; GID],
}

/// Bytes that are no attachment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AttachmentError(usize);

impl fmt::Display for AttachmentError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "an attachment of {} bytes, in place of {LENGTH}: is the sender rmw_zenoh of ROS 2 Jazzy or later?",
            self.0
        )
    }
}

impl std::error::Error for AttachmentError {}

impl Attachment {
    /// Returns the bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; LENGTH] {
        let mut bytes = [0; LENGTH];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.time_ns.to_le_bytes());
        bytes[16] = GID as u8;
        bytes[17..].copy_from_slice(&self.gid);
        bytes
    }

    /// Reads the bytes.
    ///
    /// # Errors
    /// They are no attachment.
    pub fn parse(bytes: &[u8]) -> Result<Self, AttachmentError> {
        let fault = || AttachmentError(bytes.len());
        let bytes: &[u8; LENGTH] = bytes.try_into().map_err(|_| fault())?;
        let word = |at: usize| bytes[at..at + 8].try_into().map(i64::from_le_bytes).map_err(|_| fault());
        if usize::from(bytes[16]) != GID {
            return Err(fault());
        }
        let gid = bytes[17..].try_into().map_err(|_| fault())?;
        Ok(Self { sequence: word(0)?, time_ns: word(8)?, gid })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn bytes_are_those_of_rmw_zenoh() {
        let attachment = Attachment { sequence: 1, time_ns: 0x0203, gid: [7; 16] };
        let mut expected = vec![1, 0, 0, 0, 0, 0, 0, 0, 3, 2, 0, 0, 0, 0, 0, 0, 16];
        expected.extend([7; 16]);
        assert_eq!(attachment.encode()[..], expected[..]);
        assert_eq!(Attachment::parse(&expected), Ok(attachment));
        expected[16] = 15;
        assert!(Attachment::parse(&expected).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes: Vec<u8>) {
            if let Ok(attachment) = Attachment::parse(&bytes) {
                prop_assert_eq!(&attachment.encode()[..], &bytes[..]);
            }
        }
    }
}
