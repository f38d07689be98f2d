//! Outcomes as replies of a query.
//!
//! | reply | content |
//! | --- | --- |
//! | of a confirmed message to one application | `{"outcome":"Delivered"}`, `{"outcome":"Rejected","reason":"QueueFull","text":".."}` |
//! | of one to several | `{"members":[{"tid":"10.0.0.3/1001","outcome":"Delivered"}]}` |

use serde_json::{Map, Value as Json, json};
use sinew::{Outcome, message::MemberOutcome};

use crate::{Encoding, Value};

/// Returns the outcome as an object.
fn object(outcome: Outcome) -> Map<String, Json> {
    let mut object = Map::new();
    let word = match outcome {
        Outcome::Delivered => "Delivered",
        Outcome::Rejected(_) => "Rejected",
        Outcome::Expired => "Expired",
        Outcome::Failed => "Failed",
        Outcome::PeerLost => "PeerLost",
        Outcome::Unknown => "Unknown",
    };
    object.insert("outcome".to_owned(), word.into());
    if let Outcome::Rejected(why) = outcome {
        object.insert("reason".to_owned(), format!("{why:?}").into());
        object.insert("text".to_owned(), why.to_string().into());
    }
    object
}

/// Returns the reply with the outcome of a message to one application, or of each of several.
#[must_use]
pub fn reply(outcomes: &[MemberOutcome], is_single: bool, encoding: Encoding) -> Vec<u8> {
    let json = match outcomes {
        [one] if is_single => Json::Object(object(one.outcome)),
        all => {
            let member = |one: &MemberOutcome| {
                let mut member = object(one.outcome);
                member.insert("tid".to_owned(), one.tid.to_string().into());
                Json::Object(member)
            };
            json!({ "members": all.iter().map(member).collect::<Vec<_>>() })
        }
    };
    written(&json, encoding)
}

/// Returns the error of a query: its cause, and the outcome if there is one.
#[must_use]
pub fn error(text: &str, outcome: Option<Outcome>, encoding: Encoding) -> Vec<u8> {
    let mut object = outcome.map(object).unwrap_or_default();
    object.insert("text".to_owned(), text.into());
    written(&Json::Object(object), encoding)
}

fn written(json: &Json, encoding: Encoding) -> Vec<u8> {
    let text = json.to_string().into_bytes();
    match encoding {
        Encoding::Json | Encoding::Raw => text,
        // Each JSON text is a value.
        Encoding::MessagePack => Value::read_json(&text).map_or(text, |value| value.written()),
    }
}

#[cfg(test)]
mod tests {
    use sinew::{Tid, message::Rejection};

    use super::*;

    #[test]
    fn outcome_has_its_reason() {
        let full = Outcome::Rejected(Rejection::QueueFull);
        let one = [MemberOutcome { tid: Tid::from_bits(1), outcome: full }];
        let text = String::from_utf8(reply(&one, true, Encoding::Json)).expect("JSON is text");
        assert!(text.starts_with(r#"{"outcome":"Rejected","reason":"QueueFull","text":"#), "{text}");
        let many = reply(&one, false, Encoding::MessagePack);
        let json = Value::read(&many).expect("MessagePack").json();
        assert!(json.starts_with(r#"{"members":[{"outcome":"Rejected""#), "{json}");
        let error = error("no answer", None, Encoding::Json);
        assert_eq!(error, br#"{"text":"no answer"}"#);
    }
}
