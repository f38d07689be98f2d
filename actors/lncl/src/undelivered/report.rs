//! Reports rejections: to applications, clients and other nodes, and in the log.

use std::fmt::Display;

use sinew_model::{
    rejections::{is_of_an_end, reason_of},
    undelivered::{REPORTED_MAX, Report, Reported},
};
use sinew_protocol::payload;
use sinew_runtime::{
    lock,
    outcome::{Outcome, Rejection},
    router::SubmitError,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    undelivered::Undelivered as Event,
    wire::{Kind, Message, Payload},
};

use super::{Entry, Recipient, Unhandled, Warned, log_lines::LogLine};
use crate::{Owner, State};

/// Maximum size in bytes of a client's report without entries, of a full entry, and of an entry without optional
/// fields.
const FRAME_BYTES: usize = 12;
const ENTRY_BYTES: usize = 176;
const SHORT_ENTRY_BYTES: usize = 49;

fn report_of(entries: &[Entry]) -> Report {
    let reported = entries.iter().take(REPORTED_MAX).map(|entry| Reported {
        from: entry.source,
        to: entry.destination.bits(),
        why: Outcome::Rejected(entry.why).code(),
        count: entry.count,
        kind: entry.kind,
        class: entry.class,
        first: entry.first,
        last: entry.last,
    });
    Report { entries: reported.collect() }
}

/// Adds the rejections that `node` reports. Only messages that it can have rejected count: those to it, to a group,
/// or to all. Calls `refuse` for each other one.
pub fn note(
    state: &State,
    (node, report): (NodeAddress, Report),
    now: Time,
    refuse: &mut dyn FnMut(&dyn Display),
) {
    for reported in report.entries {
        let destination = Tid::from_bits(reported.to);
        let is_its = destination == Tid::NONE || [node, NodeAddress::ALL].contains(&destination.node);
        if reported.count == 0 || !is_its {
            refuse(&format_args!("node {node} reports messages to {destination} as not delivered"));
            continue;
        }
        let entry = Entry {
            source: reported.from,
            destination,
            kind: reported.kind,
            class: reported.class,
            why: reason_of(reported.why),
            count: reported.count,
            since: now,
            first: reported.first,
            last: reported.last,
        };
        // An application that does not exist gets no report and no entry in the table.
        if lock(&state.registry).owner_of(reported.from).is_some() {
            state.undelivered.count(now, entry);
        }
    }
}

/// Sends all reports that are due at `now`. Returns whether others will be due without a further rejection. Runs on
/// LNCL's thread, without holding a lock.
pub fn report(state: &State, now: Time) -> bool {
    let payload_max = state.ctx.config.payload_max;
    let whole = payload_max.saturating_sub(FRAME_BYTES) / ENTRY_BYTES;
    let short = (payload_max.saturating_sub(FRAME_BYTES) / SHORT_ENTRY_BYTES).max(1);
    let form = if whole > 0 { Form::Whole } else { Form::Short };
    let due = {
        let mut core = lock(&state.undelivered.core);
        core.take(now, if whole > 0 { whole } else { short })
    };
    for (reader, entries) in due {
        match reader {
            // If a node accepts no reports, or is gone, its senders get none.
            Recipient::Node(node) => {
                if let Some(links) = state.ctx.ports.links() {
                    links.report_undelivered(node, &report_of(&entries));
                }
            }
            Recipient::App(app) => notify_app(state, now, app, entries, form),
        }
    }
    let (unhandled, warned) = {
        let mut core = lock(&state.undelivered.core);
        (core.unhandled.take_due(now), core.warned.take_due(now))
    };
    unhandled.iter().for_each(|(key, line)| warn_receiver(state, key, line));
    warned.iter().for_each(|(key, line)| warn_sender(state, key, line));
    lock(&state.undelivered.core).is_left()
}

/// The form of the entries in a client's report.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    Whole,
    /// Only the fields that fit the shortest payload that can be configured.
    Short,
}

fn notify_app(state: &State, now: Time, app: AppAddress, entries: Vec<Entry>, form: Form) {
    let owner = lock(&state.registry).owner_of(app);
    match owner {
        // The application is gone.
        None => {}
        Some(Owner::Client { .. } | Owner::Command) => notify_client(state, now, app, entries, form),
        Some(Owner::Node) if state.ctx.router.subscribes(app, Event::KIND) => {
            for entry in entries {
                let (source, to) = (payload::lncl_of(state.ctx.node), Tid::new(state.ctx.node, app));
                let event = Message::typed(source, to, &event_of(state, &entry));
                again_if_full(state, now, state.ctx.router.notify_app(app, event), [entry]);
            }
        }
        Some(Owner::Node) => {
            let mut core = lock(&state.undelivered.core);
            for entry in entries {
                let key = (app, entry.destination, entry.kind, Outcome::Rejected(entry.why).code());
                core.warned.note(now, key, entry.count, entry);
            }
        }
    }
}

// spec: LNCL-14
fn notify_client(state: &State, now: Time, app: AppAddress, entries: Vec<Entry>, form: Form) {
    let reported = entries.iter().map(|entry| {
        let event = event_of(state, entry);
        let mut reported = payload::UndeliveredEntry {
            to: event.destination.bits(),
            why: Outcome::Rejected(event.why).code(),
            count: event.count,
            since: event.since.as_nanos(),
            kind: None,
            class: None,
            first: None,
            last: None,
            name: None,
        };
        if form == Form::Whole {
            (reported.kind, reported.class, reported.name) = (event.kind, event.class, event.name);
            (reported.first, reported.last) = (event.first_sequence, event.last_sequence);
        }
        reported
    });
    let reported = payload::Undelivered { entries: reported.collect() };
    let (source, to) = (payload::lncl_of(state.ctx.node), Tid::new(state.ctx.node, app));
    let frame = payload::frame(Kind::LNCL_UNDELIVERED, source, to, &reported);
    again_if_full(state, now, state.ctx.router.notify_app(app, frame), entries);
}

/// Adds the entries again if the receiver's queue was full; the next report includes them.
fn again_if_full(
    state: &State,
    now: Time,
    result: Result<(), SubmitError>,
    entries: impl IntoIterator<Item = Entry>,
) {
    if matches!(result, Err(SubmitError { why: Rejection::QueueFull, .. })) {
        let mut core = lock(&state.undelivered.core);
        for entry in entries {
            core.add(now, Recipient::App(entry.source), entry);
        }
    }
}

fn event_of(state: &State, entry: &Entry) -> Event {
    Event {
        destination: entry.destination,
        name: name_of(state, entry.destination),
        kind: entry.kind,
        class: entry.class,
        why: entry.why,
        count: entry.count,
        since: entry.since,
        first_sequence: entry.first,
        last_sequence: entry.last,
    }
}

/// Returns the name of an application, on any node, if it is known.
fn name_of(state: &State, tid: Tid) -> Option<String> {
    if tid.node == state.ctx.node {
        return lock(&state.registry).own_name_of(tid.app);
    }
    state.ctx.ports.names()?.directory().into_iter().find(|entry| entry.tid == tid).map(|entry| entry.name)
}

/// Returns a TID with its name, for display.
fn describe(state: &State, tid: Tid) -> String {
    match name_of(state, tid) {
        Some(name) => format!("{name} ({tid})"),
        None => tid.to_string(),
    }
}

/// Returns the name of a type, for display.
fn describe_type(state: &State, kind: Option<Kind>) -> String {
    let Some(kind) = kind else { return "several types".to_owned() };
    kind_name(state, kind).unwrap_or_else(|| format!("kind {kind}"))
}

/// Returns the name of a type, if an application of this node registered it, or this process sends or handles it.
pub fn kind_name(state: &State, kind: Kind) -> Option<String> {
    let named = lock(&state.registry).kind_name(kind).map(str::to_owned);
    named.or_else(|| kind.type_name().map(str::to_owned))
}

/// Returns the remedy for a type that a receiver does not handle.
pub fn remedy(app: AppAddress, kind: Kind) -> String {
    if app.is_layer() {
        return "it is a part of its node and handles none of the program's types; is the destination right?"
            .to_owned();
    }
    let name = kind.rust_name().unwrap_or("T");
    format!("add `.handles::<{name}>()` to its AppSpec and implement `Handler<Delivery<{name}>>`")
}

fn warn_receiver(state: &State, key: &Unhandled, line: &LogLine<Tid>) {
    let &(app, kind, why) = key;
    // The application itself has logged why it cannot read a message.
    if why != Outcome::Rejected(Rejection::UnknownKind).code() {
        return;
    }
    let receiver = describe(state, Tid::new(state.ctx.node, app));
    let sender = describe(state, line.about);
    let named = kind_name(state, kind);
    let kind_name = named.unwrap_or_else(|| format!("kind {kind} (the log of its sender names it)"));
    let (messages, remedy) = (line.unlogged, remedy(app, kind));
    sinew_runtime::log::warn!(messages, "{receiver} does not handle {kind_name}, sent by {sender}: {remedy}");
}

fn warn_sender(state: &State, key: &Warned, line: &LogLine<Entry>) {
    let (sender, messages) = (describe(state, Tid::new(state.ctx.node, key.0)), line.unlogged);
    let Entry { destination, kind, why, .. } = line.about;
    let kind = describe_type(state, kind);
    let to = if destination == Tid::NONE {
        "several destinations".to_owned()
    } else {
        describe(state, destination)
    };
    if is_of_an_end(why) {
        sinew_runtime::log::info!(messages, "{kind} that {sender} sent to {to} was not delivered: {why}");
    } else {
        sinew_runtime::log::warn!(messages, "{kind} that {sender} sent to {to} was not delivered: {why}");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sinew_runtime::{
        mailbox::Mailbox,
        tid::Incarnation,
        wire::{Class, Header, decode, encode},
    };

    use super::*;
    use crate::{LocalApp, register_local};
    use sinew_model::config::NodeConfig;

    fn reported(from: AppAddress, to: Tid, count: u64) -> Reported {
        let why = Outcome::Rejected(Rejection::UnknownKind).code();
        Reported { from, to: to.bits(), why, count, kind: None, class: None, first: None, last: None }
    }

    // spec: GNCL-20
    #[test]
    fn peer_reports_refusals_only_to_applications_that_are_present() {
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let app = LocalApp {
            name: Some("hip".to_owned()),
            address: None,
            requires: vec![],
            kinds: vec![],
            sink: Mailbox::new(1),
            events: Arc::new([]),
        };
        let hip = register_local(&state, app).expect("nothing is in the way").app;
        let [peer, other] = [9, 10].map(NodeAddress::new);
        let knee = |node| Tid::new(node, AppAddress::new(0x1001));
        let absent = AppAddress::fixed(7).expect("in the range");
        let entries = vec![
            reported(hip, knee(peer), 3),
            reported(hip, knee(other), 1),
            reported(hip, knee(state.ctx.node), 1),
            reported(hip, knee(peer), 0),
            reported(absent, knee(peer), 1),
        ];
        let mut refused = 0;
        note(&state, (peer, Report { entries }), Time::ZERO, &mut |_| refused += 1);
        assert_eq!(refused, 3);
        let due = lock(&state.undelivered.core).take(Time::ZERO, usize::MAX);
        let [(Recipient::App(reader), kept)] = &due[..] else { panic!("{due:?}") };
        assert_eq!((*reader, kept.len(), kept[0].count), (hip, 1, 3));
    }

    // spec: GNCL-20
    #[test]
    fn a_longer_report_than_there_may_be_is_refused() {
        let app = AppAddress::new(0x1001);
        let report = |entries| Report { entries: vec![reported(app, Tid::NONE, 1); entries] };
        for (entries, is_read) in [(REPORTED_MAX, true), (REPORTED_MAX + 1, false)] {
            assert_eq!(decode::<Report>(&encode(&report(entries))).is_ok(), is_read, "{entries}");
        }
    }

    #[test]
    fn no_report_is_longer_than_it_is_counted() {
        let long = || payload::UndeliveredEntry {
            to: u64::MAX,
            why: u8::MAX,
            count: u64::MAX,
            since: u64::MAX,
            kind: Some(Kind::named("a")),
            class: Some(Class::Control),
            first: Some(u64::MAX),
            last: Some(u64::MAX),
            name: Some("x".repeat(63)),
        };
        let short = || payload::UndeliveredEntry {
            kind: None,
            class: None,
            first: None,
            last: None,
            name: None,
            ..long()
        };
        for entries in [0, 1, 15, 16, 27] {
            let bytes = |entry: &dyn Fn() -> payload::UndeliveredEntry| {
                encode(&payload::Undelivered { entries: (0..entries).map(|_| entry()).collect() }).len()
            };
            assert!(bytes(&long) <= FRAME_BYTES + entries * ENTRY_BYTES, "{entries}: {}", bytes(&long));
            assert!(
                bytes(&short) <= FRAME_BYTES + entries * SHORT_ENTRY_BYTES,
                "{entries}: {}",
                bytes(&short)
            );
        }
        let mut header = Header::new(Kind::named("a"), Tid::from_bits(u64::MAX), Tid::from_bits(u64::MAX));
        header.sequence = u64::MAX;
        let entry = Entry::of(&header, Rejection::NotAllowed, u64::MAX, Time::MAX);
        let report = report_of(&[entry; 2 * REPORTED_MAX]);
        assert_eq!(report.entries.len(), REPORTED_MAX);
        assert!(encode(&report).len() <= 4_096, "as long as a frame of GNCL itself may be");
    }
}
