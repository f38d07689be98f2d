//! `sinew send` to a group, to all applications, or to an address on all nodes.

use std::{collections::BTreeMap, time::Duration};

use serde_json::{Value, json};
use sinew::{
    Outcome, Tid, Time,
    client::{ApiError, LoanedMessage},
    inspect::{AppsReport, AskApps},
    message::{Kind, MemberOutcome},
};

use super::{ClassName, Order, fault};
use crate::{
    Report,
    system::{Fault, System},
    table::{clean, time},
};

/// Sends it to each member, and says what became of it at each, unless it is not to be confirmed.
pub(super) fn to_many(
    system: &mut System,
    to: Tid,
    content: (Kind, &[u8]),
    order: &Order,
) -> Result<Report, Fault> {
    if order.ask {
        let target = clean(&order.target);
        return Err(Fault::Usage(format!(
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
    let told = lend(system, to, (kind, payload), order)
        .and_then(|loan| system.endpoint.loaned(loan).confirmed_by_each(within));
    let micros = u64::try_from(Time::now().since(began).as_micros()).unwrap_or(u64::MAX);
    let (members, error) = match told {
        Ok(members) => (members, None),
        Err(error) => (Vec::new(), Some(clean(&error.to_string()))),
    };
    let names = names(system, to, &members);
    let members: Vec<_> = members.into_iter().map(|member| Line::of(member, to, &names, order)).collect();
    let taken = members.iter().filter(|line| line.fault.is_none()).count();
    let result = match (&error, members.len()) {
        (Some(why), _) => why.clone(),
        (None, 0) => reached_nobody(order).to_owned(),
        (None, count) => format!("delivered to {taken} of {count} members, after {}", time(micros)),
    };
    let lines: String = members.iter().map(|line| format!("{}: {}\n", line.label, line.result())).collect();
    let is_fine = error.is_none() && taken == members.len() && !is_misspelt(order, members.is_empty());
    let json = json!({
        "tid": to.to_string(), "kind": kind.to_string(), "bytes": payload.len(), "took_us": micros, "fault": error,
        "members": members.iter().map(Line::json).collect::<Vec<_>>(),
    });
    Report { text: format!("{} ({to}): {result}\n{lines}", clean(&order.target)), json, is_fine }
}

/// What became of it at one member.
struct Line {
    member: MemberOutcome,
    name: Option<String>,
    label: String,
    fault: Option<String>,
}

impl Line {
    fn of(member: MemberOutcome, to: Tid, names: &BTreeMap<Tid, String>, order: &Order) -> Self {
        let MemberOutcome { tid, outcome } = member;
        let name = names.get(&tid).cloned();
        let label = match &name {
            Some(name) => format!("{} ({tid})", clean(name)),
            None if is_for_a_node(tid, to) => format!("all members on {}", tid.node),
            None => tid.to_string(),
        };
        Self { member, name, label, fault: fault(outcome, order) }
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

/// Whether an entry stands for all members of a node, which has not named them.
fn is_for_a_node(tid: Tid, to: Tid) -> bool {
    !tid.is_single() && tid.app == to.app
}

/// The names of members, as their nodes say; of nodes that have answered.
fn names(system: &mut System, to: Tid, members: &[MemberOutcome]) -> BTreeMap<Tid, String> {
    let has_answered = |member: &&MemberOutcome| {
        !is_for_a_node(member.tid, to) && !matches!(member.outcome, Outcome::Unknown | Outcome::PeerLost)
    };
    let mut nodes: Vec<_> =
        members.iter().filter(has_answered).map(|member| (member.tid.node, String::new())).collect();
    nodes.dedup();
    let answers = system.ask_these::<AskApps, AppsReport>(nodes);
    let apps = answers.into_iter().filter_map(|answer| answer.said.ok()).flat_map(|said| said.apps);
    apps.filter_map(|app| Some((app.tid, app.name?))).collect()
}

fn unconfirmed(
    system: &mut System,
    to: Tid,
    (kind, payload): (Kind, &[u8]),
    order: &Order,
) -> Result<Report, Fault> {
    let (members, silent) = system.members(to)?;
    // With nobody there to send to, nothing is sent and nothing can fail.
    let fault = if members.is_empty() {
        None
    } else {
        let sent =
            lend(system, to, (kind, payload), order).and_then(|loan| system.endpoint.loaned(loan).send());
        sent.err().map(|error| clean(&error.to_string()))
    };
    let result = match (&fault, members.len()) {
        (Some(why), _) => why.clone(),
        (None, 0) => reached_nobody(order).to_owned(),
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
    let is_fine = fault.is_none() && silent.is_empty() && !is_misspelt(order, members.is_empty());
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

/// A group that is named by its TID is known to be one. A bare name that has no member may be misspelt.
fn is_misspelt(order: &Order, is_empty: bool) -> bool {
    is_empty && order.target.parse::<Tid>().is_err()
}

fn reached_nobody(order: &Order) -> &'static str {
    if is_misspelt(order, true) {
        "no application has this name, and no group of this name has a member; the message reached nobody. \
         `sinew apps` shows the applications"
    } else {
        "no application is a member; the message reached nobody"
    }
}
