//! The reason with which a node gives up, as sent to its peers: in `NDL_LEAVE` and in GOODBYE.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Maximum bytes of a reason: together with the longest announcement it fits into a datagram of NDL.
const BYTES_MAX: usize = 200;

/// The reason why a node gave up: 1 to 200 bytes without control characters. // spec: NDL-4.8
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct LeaveReason(Arc<str>);

impl LeaveReason {
    /// Returns the reason in a form that peers accept: control characters become spaces, and a text that is
    /// too long is cut.
    pub fn of(reason: &str) -> Self {
        let mut text = String::with_capacity(BYTES_MAX);
        for letter in reason.chars().map(|letter| if letter.is_control() { ' ' } else { letter }) {
            if text.len() + letter.len_utf8() > BYTES_MAX {
                break;
            }
            text.push(letter);
        }
        if text.is_empty() {
            text.push_str("no reason given");
        }
        Self(text.into())
    }

    /// Returns the text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<LeaveReason> for String {
    fn from(text: LeaveReason) -> Self {
        text.0.as_ref().to_owned()
    }
}

impl TryFrom<String> for LeaveReason {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        if (1..=BYTES_MAX).contains(&text.len()) && !text.contains(char::is_control) {
            Ok(Self(text.into()))
        } else {
            Err(
                "the reason of a node that gave up is empty, longer than 200 bytes, or has control characters",
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reason_is_cut_at_char_boundary_without_control_chars() {
        let text = LeaveReason::of(&format!("line\nnext\u{1b}[31m {}", "é".repeat(200)));
        assert!(text.as_str().len() <= BYTES_MAX && text.as_str().starts_with("line next [31m é"));
        assert_eq!(LeaveReason::try_from(String::from(text.clone())), Ok(text));
    }

    #[test]
    fn invalid_reason_is_refused() {
        for bad in [String::new(), "x".repeat(201), "a\nb".to_owned()] {
            assert!(LeaveReason::try_from(bad).is_err());
        }
    }
}
