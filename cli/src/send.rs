//! `sinew send`: one message, and what became of it.

mod many;

use std::io::Read;

use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use sinew::{
    Class, Outcome, Tid, Time,
    client::{ApiError, LoanedMessage},
    message::Kind,
};

use crate::{
    Report, messagepack, ping,
    system::{Fault, System},
    table::{clean, time},
};

/// Longest payload that is read from the standard input, in bytes: no node takes more.
const INPUT_MAX: u64 = 64 << 20;

/// What to send, and how.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// An application's TID (127.0.0.2/80000001) or name, or a group's name
    pub(crate) target: String,
    /// The payload's type as its program calls it (demo.angle), or its number (0x9c1b6bda)
    kind: String,
    /// The payload, as JSON; `-` reads it from the standard input. A type without fields takes `{}`, `null` and `''` (no bytes)
    #[arg(default_value = "{}")]
    payload: String,
    /// Wait for a reply, and print it
    #[arg(long, conflicts_with_all = ["class", "unconfirmed"])]
    ask: bool,
    /// How it travels. A Stream cannot be confirmed
    #[arg(long, value_enum, default_value = "control")]
    class: ClassName,
    /// Do not wait for what becomes of it
    #[arg(long)]
    unconfirmed: bool,
    /// How long it may take. It expires where it waits when it is older
    #[arg(long, value_name = "MS", default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..=3_600_000))]
    within: u32,
}

/// A class, as it is called here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ClassName {
    /// Ordered, ahead of all else
    Control,
    /// The newest value wins
    Stream,
    /// Ordered, yields
    Bulk,
}

impl From<ClassName> for Class {
    fn from(name: ClassName) -> Self {
        match name {
            ClassName::Control => Self::Control,
            ClassName::Stream => Self::Stream,
            ClassName::Bulk => Self::Bulk,
        }
    }
}

/// What came of it.
struct Ended {
    outcome: Option<Outcome>,
    reply: Option<Value>,
    fault: Option<String>,
    /// Nobody has come to it in its time, or said so: the outcome does not tell why.
    is_unheard: bool,
}

impl Ended {
    /// A receiver that is known not to be ready is the reason why nobody has come to it, or at least not yet: where that is not known it may have
    /// been ready when the message came.
    fn explained_by(&mut self, not_ready: impl FnOnce() -> Option<String>) {
        if self.is_unheard
            && let Some(why) = not_ready()
        {
            self.fault = Some(match self.outcome {
                Some(Outcome::Expired) => format!("Expired: {why}"),
                Some(outcome) => format!("{outcome:?}: it may have been handled, but {why}"),
                None => why,
            });
        }
    }
}

/// Sends it, and says what became of it.
pub(crate) fn show(system: &mut System, order: &Order) -> Result<Report, Fault> {
    let to = system.find_or_group(&order.target)?;
    let kind = kind(&order.kind)?;
    let payload = payload(&order.payload)?;
    if !to.is_single() {
        return many::to_many(system, to, (kind, &payload), order);
    }
    let began = Time::now();
    let mut ended = send(system, to, (kind, &payload), order);
    let took = Time::now().since(began);
    ended.explained_by(|| ping::not_ready(system, to));
    let micros = u64::try_from(took.as_micros()).unwrap_or(u64::MAX);
    let said = match (&ended.fault, &ended.reply, ended.outcome) {
        (Some(why), ..) => clean(why),
        (None, Some(reply), _) => format!("{reply:#}"),
        (None, None, Some(outcome)) => format!("{outcome:?}"),
        (None, None, None) => "sent; nobody was asked what becomes of it".to_owned(),
    };
    let text = if ended.reply.is_some() && ended.fault.is_none() {
        // Alone, for a pipe.
        said + "\n"
    } else {
        format!("{} ({to}): {said}, after {}\n", clean(&order.target), time(micros))
    };
    let json = json!({
        "tid": to.to_string(), "kind": kind.to_string(), "bytes": payload.len(), "took_us": micros, "fault": ended.fault,
        "outcome": ended.outcome.map(|outcome| format!("{outcome:?}")), "reply": ended.reply,
    });
    Ok(Report { text, json, is_fine: ended.fault.is_none() })
}

fn send(system: &mut System, to: Tid, (kind, payload): (Kind, &[u8]), order: &Order) -> Ended {
    let within = std::time::Duration::from_millis(order.within.into());
    let endpoint = &mut system.endpoint;
    let lent = endpoint.create_message(to, kind, payload.len()).map(|mut lent: LoanedMessage| {
        lent.copy_from_slice(payload);
        lent.set_class(order.class.into());
        lent
    });
    let ended = lent.and_then(|lent| {
        if order.ask {
            let reply = endpoint.loaned(lent).ask_raw(within)?;
            return Ok((Some(Outcome::Delivered), Some(messagepack::shown_or_raw(reply.bytes()))));
        }
        // spec: FRAME-5
        if order.unconfirmed || order.class == ClassName::Stream {
            return endpoint.loaned(lent).send().map(|()| (None, None));
        }
        endpoint.loaned(lent).confirmed(within).map(|outcome| (Some(outcome), None))
    });
    ended_of(ended, order)
}

fn ended_of(ended: Result<(Option<Outcome>, Option<Value>), ApiError>, order: &Order) -> Ended {
    let is_open = |outcome: Outcome| matches!(outcome, Outcome::Unknown | Outcome::Expired);
    match ended {
        Ok((outcome, reply)) => Ended {
            outcome,
            reply,
            fault: outcome.and_then(|outcome| fault(outcome, order)),
            is_unheard: outcome.is_some_and(is_open),
        },
        Err(error) => {
            let outcome = if let ApiError::Ended(outcome) = error { Some(outcome) } else { None };
            let is_unheard = matches!(error, ApiError::NoReply(_)) || outcome.is_some_and(is_open);
            Ended { outcome, reply: None, fault: Some(error.to_string()), is_unheard }
        }
    }
}

/// In words, unless it was delivered.
fn fault(outcome: Outcome, order: &Order) -> Option<String> {
    let within = order.within;
    let why = match outcome {
        Outcome::Delivered => return None,
        Outcome::Rejected(why) => why.to_string(),
        Outcome::Expired => {
            format!("it was not come to within {within} ms; is the receiver busy? Give it more: --within")
        }
        Outcome::Failed => "its receiver failed, or ended with it in hand; look at `sinew tree`".to_owned(),
        Outcome::PeerLost => "its node was lost before it was sent; look at `sinew nodes`".to_owned(),
        Outcome::Unknown => format!("nobody has said within {within} ms; it may have been handled"),
    };
    Some(format!("{outcome:?}: {why}"))
}

/// The type of a payload, by name or by number.
pub(crate) fn kind(text: &str) -> Result<Kind, Fault> {
    let kind = match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).ok().map(Kind::from_bits),
        None => Some(Kind::named(text)).filter(|_| !text.is_empty()),
    };
    kind.filter(|kind| kind.is_user()).ok_or_else(|| {
        let text = clean(text);
        Fault::Usage(format!(
            "'{text}' is no type of an application's payload: a name, or 0x80000000 to 0xffffffff"
        ))
    })
}

fn payload(json: &str) -> Result<Vec<u8>, Fault> {
    let mut read = String::new();
    let text = if json == "-" {
        let input = std::io::stdin().take(INPUT_MAX).read_to_string(&mut read);
        input.map_err(|error| Fault::Usage(format!("the standard input cannot be read: {error}")))?;
        &read
    } else {
        json
    };
    if text.trim().is_empty() {
        return Ok(Vec::new());
    }
    let value: Value = serde_json::from_str(text).map_err(|error| {
        Fault::Usage(format!("the payload is no JSON: {error}. A text needs its quotes: '\"on\"'"))
    })?;
    messagepack::written(&value).map_err(Fault::Usage)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew::message::Rejection;

    use super::*;

    fn order() -> Order {
        Order {
            target: "knee".to_owned(),
            kind: "demo.angle".to_owned(),
            payload: "{}".to_owned(),
            ask: false,
            class: ClassName::Control,
            unconfirmed: false,
            within: 2_000,
        }
    }

    /// What is said of it where the receiver is known not to be ready.
    fn said_of_a_waiting(ended: Result<Outcome, ApiError>) -> String {
        let mut ended = ended_of(ended.map(|outcome| (Some(outcome), None)), &order());
        ended.explained_by(|| Some("it is not ready: has waited 2.0 s for ankle (not there)".to_owned()));
        ended.fault.unwrap_or_default()
    }

    #[test]
    fn a_message_that_nobody_came_to_is_explained_by_a_receiver_that_is_not_ready() {
        let why = "it is not ready: has waited 2.0 s for ankle (not there)";
        let unknown = format!("Unknown: it may have been handled, but {why}");
        assert_eq!(said_of_a_waiting(Ok(Outcome::Unknown)), unknown);
        assert_eq!(said_of_a_waiting(Ok(Outcome::Expired)), format!("Expired: {why}"));
        assert_eq!(said_of_a_waiting(Err(ApiError::Ended(Outcome::Unknown))), unknown);
        assert_eq!(said_of_a_waiting(Err(ApiError::NoReply(Duration::from_secs(2)))), why);
    }

    #[test]
    fn what_has_a_reason_of_its_own_keeps_it_and_nobody_is_asked_for_another() {
        assert_eq!(said_of_a_waiting(Ok(Outcome::Delivered)), "");
        let full = Outcome::Rejected(Rejection::QueueFull);
        for ended in [Ok(full), Ok(Outcome::PeerLost), Err(ApiError::Ended(full)), Err(ApiError::LoanActive)]
        {
            let said = said_of_a_waiting(ended);
            assert!(!said.is_empty() && !said.contains("not ready"), "{said}");
        }
    }

    #[test]
    fn a_message_to_one_that_is_ready_is_unknown_as_nobody_has_said() {
        let mut ended = ended_of(Ok((Some(Outcome::Unknown), None)), &order());
        ended.explained_by(|| None);
        let said = ended.fault.expect("it is no success");
        assert!(said.starts_with("Unknown: nobody has said within 2000 ms"), "{said}");
    }
}
