//! The attachment of a message for Zenoh: the header that it had in Sinew, as JSON.
//!
//! ```json
//! {"age_error_us":12,"age_us":340,"bridge":"9f..","class":"stream","sequence":17,"source":"10.0.0.3/1001"}
//! ```

use std::time::Duration;

use serde_json::{Value as Json, json};
use sinew::{Tid, message::Class};

/// Maximum length in bytes of an attachment that is looked at.
const LOOKED_AT_MAX: usize = 1_024;

/// The header of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The sender; its node guarantees it.
    pub source: Tid,
    /// The sequence number at the sender.
    pub sequence: u64,
    /// The class.
    pub class: Class,
    /// The age when the bridge received it, and the maximum error of it; `None`: unknown.
    pub age: Option<(Duration, Duration)>,
}

/// Returns the word for a class, as in the configuration file.
#[must_use]
pub const fn class_word(class: Class) -> &'static str {
    match class {
        Class::Control => "control",
        Class::Stream => "stream",
        Class::Bulk => "bulk",
    }
}

/// Returns the attachment of a message. `bridge` is the session's id, by which other bridges know its origin.
#[must_use]
pub fn attachment(header: &Header, bridge: &str) -> String {
    let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
    let json = json!({
        "bridge": bridge, "source": header.source.to_string(), "sequence": header.sequence,
        "class": class_word(header.class), "age_us": header.age.map(|(age, _)| micros(age)),
        "age_error_us": header.age.map(|(_, error)| micros(error)),
    });
    json.to_string()
}

/// Returns whether a bridge has made this attachment.
#[must_use]
pub fn is_of_bridge(attachment: &[u8]) -> bool {
    if attachment.len() > LOOKED_AT_MAX {
        return false;
    }
    let json: Result<Json, _> = serde_json::from_slice(attachment);
    json.is_ok_and(|json| json.get("bridge").is_some_and(Json::is_string))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bridge_recognizes_its_attachments_alone() {
        let age = Some((Duration::from_micros(340), Duration::ZERO));
        let header = Header { source: Tid::from_bits(1), sequence: 17, class: Class::Stream, age };
        let made = attachment(&header, "9f");
        assert!(is_of_bridge(made.as_bytes()), "{made}");
        assert!(made.contains("\"age_us\":340") && made.contains("\"class\":\"stream\""), "{made}");
        for other in [&b""[..], b"{}", b"{\"bridge\":1}", b"bridge", &[0xff; 40], &[b'['; 2_000]] {
            assert!(!is_of_bridge(other));
        }
    }
}
