//! `sinew send` to a group, to all applications, or to an address on all nodes.

use std::{collections::BTreeMap, time::Duration};

use serde_json::{Value, json};
use sinew::{
    Outcome, Tid, Time,
    client::{ApiError, LoanedMessage},
    message::{Kind, MemberOutcome},
};

use super::{ClassName, Order, explained, explained::Receiver, fault};
use crate::{
    Report,
    system::{System, SystemError},
    table::{clean, time},
    unknown::Target,
};

/// Sends a message to each member, and reports the outcome at each, unless it is unconfirmed.
pub(super) fn to_many(
    system: &mut System,
    to: Tid,
    content: (Kind, &[u8]),
    order: &Order,
) -> Result<Report, SystemError> {
    if order.ask {
        if is_misspelt(order, true) && system.members(to)?.0.is_empty() {
            return Err(system.unknown(&order.target, Target::OneOrGroup));
        }
        let target = clean(&order.target);
        return Err(SystemError::Usage(format!(
            "'{target}' is a group, and --ask asks one application; name a member of it"
        )));
    }
    // spec: FRAME-5
    if order.unconfirmed || order.class == ClassName::Stream {
        unconfirmed(system, to, content, order)
    } else {
        Ok(confirmed(system, to, content, order))
    }
}

fn confirmed(system: &mut System, to: Tid, (kind, payload): (Kind, &[u8]), order: &Order) -> Report {
    let began = Time::now();
    let within = Duration::from_millis(order.within.into());
    let sent = lend(system, to, (kind, payload), order)
        .and_then(|loan| system.endpoint.loaned(loan).confirmed_by_each(within));
    let micros = u64::try_from(Time::now().since(began).as_micros()).unwrap_or(u64::MAX);
    let (members, error) = match sent {
        Ok(members) => (members, None),
        Err(error) => (Vec::new(), Some(clean(&error.to_string()))),
    };
    let receivers = answered(system, to, &members);
    let members: Vec<_> = members.into_iter().map(|member| Line::of(member, to, &receivers, order)).collect();
    let taken = members.iter().filter(|line| line.fault.is_none()).count();
    let is_unknown = error.is_none() && is_misspelt(order, members.is_empty());
    let error = if is_unknown { Some(unknown(system, order)) } else { error };
    let result = match (&error, members.len()) {
        (Some(why), _) => why.clone(),
        (None, 0) => REACHED_NONE.to_owned(),
        (None, count) => format!("delivered to {taken} of {count} members, after {}", time(micros)),
    };
    let lines: String = members.iter().map(|line| format!("{}: {}\n", line.label, line.result())).collect();
    let is_fine = error.is_none() && taken == members.len();
    let json = json!({
        "tid": to.to_string(), "kind": kind.to_string(), "bytes": payload.len(), "took_us": micros, "fault": error,
        "members": members.iter().map(Line::json).collect::<Vec<_>>(),
    });
    Report { text: format!("{} ({to}): {result}\n{lines}", clean(&order.target)), json, is_fine }
}

/// The outcome at one member.
struct Line {
    member: MemberOutcome,
    name: Option<String>,
    label: String,
    fault: Option<String>,
}

impl Line {
    fn of(member: MemberOutcome, to: Tid, receivers: &BTreeMap<Tid, Receiver>, order: &Order) -> Self {
        let MemberOutcome { tid, outcome } = member;
        let receiver = receivers.get(&tid);
        let name = receiver.and_then(|receiver| receiver.app.name.clone());
        let about = receiver.and_then(|receiver| explained::by_types(outcome, receiver, order));
        let label = match &name {
            Some(name) => format!("{} ({tid})", clean(name)),
            None if is_for_a_node(tid, to) => format!("all members on {}", tid.node),
            None => tid.to_string(),
        };
        let fault = fault(outcome, order).map(|fault| clean(&fault) + &about.unwrap_or_default());
        Self { member, name, label, fault }
    }

    fn result(&self) -> &str {
        self.fault.as_deref().unwrap_or("Delivered")
    }

    fn json(&self) -> Value {
        let Self { member, name, fault, .. } = self;
        json!({
            "tid": member.tid.to_string(), "name": name, "outcome": format!("{:?}", member.outcome), "fault": fault,
        })
    }
}

/// Returns whether an entry represents all members of a node that has not listed them.
fn is_for_a_node(tid: Tid, to: Tid) -> bool {
    !tid.is_single() && tid.app == to.app
}

/// Returns the members on nodes that have answered, as their nodes report them.
fn answered(system: &mut System, to: Tid, members: &[MemberOutcome]) -> BTreeMap<Tid, Receiver> {
    let has_answered = |member: &&MemberOutcome| {
        !is_for_a_node(member.tid, to) && !matches!(member.outcome, Outcome::Unknown | Outcome::PeerLost)
    };
    let mut nodes: Vec<_> = members.iter().filter(has_answered).map(|member| member.tid.node).collect();
    nodes.dedup();
    explained::receivers(system, nodes)
}

fn unconfirmed(
    system: &mut System,
    to: Tid,
    (kind, payload): (Kind, &[u8]),
    order: &Order,
) -> Result<Report, SystemError> {
    let (members, silent) = system.members(to)?;
    // Without members nothing is sent, and nothing can fail.
    let fault = if is_misspelt(order, members.is_empty()) {
        Some(unknown(system, order))
    } else if members.is_empty() {
        None
    } else {
        let sent =
            lend(system, to, (kind, payload), order).and_then(|loan| system.endpoint.loaned(loan).send());
        sent.err().map(|error| clean(&error.to_string()))
    };
    let result = match (&fault, members.len()) {
        (Some(why), _) => why.clone(),
        (None, 0) => REACHED_NONE.to_owned(),
        (None, 1) => "sent to 1 member, without confirmation".to_owned(),
        (None, count) => format!("sent to {count} members, without confirmation"),
    };
    let silent_lines: String =
        silent.iter().map(|line| format!("its members are unknown: {line}\n")).collect();
    let json = json!({
        "tid": to.to_string(), "kind": kind.to_string(), "bytes": payload.len(), "fault": fault,
        "members": members.iter().map(ToString::to_string).collect::<Vec<_>>(), "silent": silent,
    });
    let text = format!("{} ({to}): {result}\n{silent_lines}", clean(&order.target));
    let is_fine = fault.is_none() && silent.is_empty();
    Ok(Report { text, json, is_fine })
}

fn lend(
    system: &mut System,
    to: Tid,
    (kind, payload): (Kind, &[u8]),
    order: &Order,
) -> Result<LoanedMessage, ApiError> {
    let mut loan = system.endpoint.create_message(to, kind, payload.len())?;
    loan.copy_from_slice(payload);
    loan.set_class(order.class.into());
    Ok(loan)
}

/// Returns whether the name may be misspelt: a group given by its TID exists by definition, but a bare name without a
/// member may be an error.
fn is_misspelt(order: &Order, is_empty: bool) -> bool {
    is_empty && order.target.parse::<Tid>().is_err()
}

const REACHED_NONE: &str = "no application is a member; the message reached no application";

/// Returns that no application has the name, with similar names.
fn unknown(system: &mut System, order: &Order) -> String {
    let why = system.unknown(&order.target, Target::OneOrGroup);
    format!("the message reached no application: {why}")
}
