//! The reason with which a node gives up, as its peers are sent it: in `NDL_LEAVE` and in GOODBYE.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Longest reason in bytes: with the longest announcement it fits a datagram of NDL.
const BYTES_MAX: usize = 200;

/// Why a node gave up: 1 to [`BYTES_MAX`] bytes without control characters. // spec: NDL-4.8
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(crate) struct LastWords(Arc<str>);

impl LastWords {
    /// The reason in a form that peers take: control characters become spaces, and a text that is too long is cut.
    pub(crate) fn of(reason: &str) -> Self {
        let mut words = String::with_capacity(BYTES_MAX);
        for letter in reason.chars().map(|letter| if letter.is_control() { ' ' } else { letter }) {
            if words.len() + letter.len_utf8() > BYTES_MAX {
                break;
            }
            words.push(letter);
        }
        if words.is_empty() {
            words.push_str("no reason given");
        }
        Self(words.into())
    }

    /// The text.
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<LastWords> for String {
    fn from(words: LastWords) -> Self {
        words.0.as_ref().to_owned()
    }
}

impl TryFrom<String> for LastWords {
    type Error = &'static str;

    fn try_from(words: String) -> Result<Self, Self::Error> {
        if (1..=BYTES_MAX).contains(&words.len()) && !words.contains(char::is_control) {
            Ok(Self(words.into()))
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
    fn a_reason_is_cut_at_a_letter_and_has_no_control_characters() {
        let words = LastWords::of(&format!("line\nnext\u{1b}[31m {}", "é".repeat(200)));
        assert!(words.as_str().len() <= BYTES_MAX && words.as_str().starts_with("line next [31m é"));
        assert_eq!(LastWords::try_from(String::from(words.clone())), Ok(words));
    }

    #[test]
    fn a_reason_that_no_node_sends_is_refused() {
        for bad in [String::new(), "x".repeat(201), "a\nb".to_owned()] {
            assert!(LastWords::try_from(bad).is_err());
        }
    }
}
