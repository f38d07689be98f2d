//! `sinew send`: sends one message, and shows its outcome.

mod explained;
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
    system::{System, SystemError},
    table::{clean, time},
};
use explained::Receiver;

/// Maximum bytes of a payload read from the standard input: no node accepts more.
const INPUT_MAX: u64 = 64 << 20;

/// The arguments of `sinew send`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// An application's TID (127.0.0.2/80000001) or name, or a group's name
    pub(crate) target: String,
    /// The payload's type as its program calls it (demo.angle), or its number (0x9c1b6bda)
    kind: String,
    /// The payload, as JSON; `-` reads it from the standard input. A type without fields takes `{}`, `null`
    /// and `''` (no bytes)
    #[arg(default_value = "{}")]
    payload: String,
    /// Wait for a reply, and print it
    #[arg(long, conflicts_with_all = ["class", "unconfirmed"])]
    ask: bool,
    /// How it travels. A Stream cannot be confirmed
    #[arg(long, value_enum, default_value = "control")]
    class: ClassName,
    /// Do not wait for its outcome
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

/// The result of a message.
struct Ended {
    outcome: Option<Outcome>,
    reply: Option<Value>,
    fault: Option<String>,
    /// Whether the receiver has not handled the message in time, or not reported it: the outcome does not state why.
    is_open: bool,
}

impl Ended {
    /// Adds an explanation. If the receiver is known not to be ready, that explains why it has not handled
    /// the message, at least not yet; otherwise it may have been ready when the message arrived. If the
    /// receiver has refused the type, the explanation lists the types that it handles.
    fn explained_by(&mut self, order: &Order, receiver: impl FnOnce() -> Option<Receiver>) {
        if !self.is_open && !self.outcome.is_some_and(explained::is_about_types) {
            return;
        }
        let Some(receiver) = receiver() else { return };
        if !self.is_open {
            let about = self.outcome.and_then(|outcome| explained::by_types(outcome, &receiver, order));
            self.fault = self.fault.take().map(|fault| fault + &about.unwrap_or_default());
        } else if let Some(why) = ping::unready(&receiver.app) {
            self.fault = Some(match self.outcome {
                Some(Outcome::Expired) => format!("Expired: {why}"),
                Some(outcome) => format!("{outcome:?}: it may have been handled, but {why}"),
                None => why,
            });
        }
    }
}

/// Sends the message, and reports its outcome.
pub(crate) fn show(system: &mut System, order: &Order) -> Result<Report, SystemError> {
    let to = system.find_or_group(&order.target)?;
    let kind = kind(&order.kind)?;
    let payload = payload(&order.payload)?;
    if !to.is_single() {
        return many::to_many(system, to, (kind, &payload), order);
    }
    let began = Time::now();
    let mut ended = send(system, to, (kind, &payload), order);
    let took = Time::now().since(began);
    ended.explained_by(order, || explained::receivers(system, vec![to.node]).remove(&to));
    let micros = u64::try_from(took.as_micros()).unwrap_or(u64::MAX);
    let result = match (&ended.fault, &ended.reply, ended.outcome) {
        (Some(why), ..) => clean(why),
        (None, Some(reply), _) => format!("{reply:#}"),
        (None, None, Some(outcome)) => format!("{outcome:?}"),
        (None, None, None) => "sent without confirmation".to_owned(),
    };
    let text = if ended.reply.is_some() && ended.fault.is_none() {
        // Printed alone, for a pipe.
        result + "\n"
    } else {
        format!("{} ({to}): {result}, after {}\n", clean(&order.target), time(micros))
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
            is_open: outcome.is_some_and(is_open),
        },
        Err(error) => {
            let outcome = if let ApiError::Ended(outcome) = error { Some(outcome) } else { None };
            let is_open = matches!(error, ApiError::NoReply(_)) || outcome.is_some_and(is_open);
            Ended { outcome, reply: None, fault: Some(error.to_string()), is_open }
        }
    }
}

/// Returns the fault as text, unless the message was delivered.
fn fault(outcome: Outcome, order: &Order) -> Option<String> {
    let within = order.within;
    let why = match outcome {
        Outcome::Delivered => return None,
        Outcome::Rejected(why) => why.to_string(),
        Outcome::Expired => {
            format!("the receiver did not come to it within {within} ms; is it busy? Give it more: --within")
        }
        Outcome::Failed => {
            "its receiver failed, or ended before it had handled it; look at `sinew tree`".to_owned()
        }
        Outcome::PeerLost => "its node was lost before it was sent; look at `sinew nodes`".to_owned(),
        Outcome::Unknown => format!("no outcome within {within} ms; it may have been handled"),
    };
    Some(format!("{outcome:?}: {why}"))
}

/// Returns the type of a payload, by name or by number.
pub(crate) fn kind(text: &str) -> Result<Kind, SystemError> {
    let kind = match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).ok().map(Kind::from_bits),
        None => Some(Kind::named(text)).filter(|_| !text.is_empty()),
    };
    kind.filter(|kind| kind.is_user()).ok_or_else(|| {
        let text = clean(text);
        SystemError::Usage(format!(
            "'{text}' is no type of an application's payload: a name, or 0x80000000 to 0xffffffff"
        ))
    })
}

fn payload(json: &str) -> Result<Vec<u8>, SystemError> {
    let mut read = String::new();
    let text = if json == "-" {
        let input = std::io::stdin().take(INPUT_MAX).read_to_string(&mut read);
        input.map_err(|error| SystemError::Usage(format!("the standard input cannot be read: {error}")))?;
        &read
    } else {
        json
    };
    if text.trim().is_empty() {
        return Ok(Vec::new());
    }
    let value: Value = serde_json::from_str(text).map_err(|error| {
        SystemError::Usage(format!("the payload is no JSON: {error}. A text needs its quotes: '\"on\"'"))
    })?;
    messagepack::written(&value).map_err(SystemError::Usage)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew::{
        inspect::{AppReport, Missing},
        message::Rejection,
    };

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

    /// The knee, which waits for an ankle, and handles these types.
    fn waiting() -> Receiver {
        let missing = Missing { name: "ankle".to_owned(), why: "not there".to_owned(), since_us: None };
        Receiver {
            node: "leg".to_owned(),
            app: AppReport { missing: vec![missing], ..explained::tests::app(&["demo.angle"]) },
        }
    }

    /// Returns the reported text if the receiver is known not to be ready.
    fn text_of_a_waiting(ended: Result<Outcome, ApiError>) -> String {
        let mut ended = ended_of(ended.map(|outcome| (Some(outcome), None)), &order());
        ended.explained_by(&order(), || Some(waiting()));
        ended.fault.unwrap_or_default()
    }

    #[test]
    fn unconfirmed_message_is_explained_by_an_unready_receiver() {
        let why = "it is not ready: has waited 2.0 s for ankle (not there)";
        let unknown = format!("Unknown: it may have been handled, but {why}");
        assert_eq!(text_of_a_waiting(Ok(Outcome::Unknown)), unknown);
        assert_eq!(text_of_a_waiting(Ok(Outcome::Expired)), format!("Expired: {why}"));
        assert_eq!(text_of_a_waiting(Err(ApiError::Ended(Outcome::Unknown))), unknown);
        assert_eq!(text_of_a_waiting(Err(ApiError::NoReply(Duration::from_secs(2)))), why);
    }

    #[test]
    fn known_reason_is_kept_without_another_query() {
        assert_eq!(text_of_a_waiting(Ok(Outcome::Delivered)), "");
        let full = Outcome::Rejected(Rejection::QueueFull);
        for ended in [Ok(full), Ok(Outcome::PeerLost), Err(ApiError::Ended(full)), Err(ApiError::LoanActive)]
        {
            let text = text_of_a_waiting(ended);
            assert!(!text.is_empty() && !text.contains("not ready"), "{text}");
        }
    }

    #[test]
    fn missing_outcome_of_a_ready_receiver_is_unknown() {
        let mut ended = ended_of(Ok((Some(Outcome::Unknown), None)), &order());
        ended.explained_by(&order(), || None);
        let fault = ended.fault.expect("it is no success");
        assert!(fault.starts_with("Unknown: no outcome within 2000 ms"), "{fault}");
    }
}
