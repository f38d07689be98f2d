//! Says what was refused: to applications, clients and other nodes, and in the log.

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::Refused,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    undelivered::Undelivered as Event,
    wire::{Class, Kind, Message, Payload},
};

use super::{Entry, Reader, Unhandled, Warned, lines::Line};
use crate::{
    lncl::{Owner, payload},
    stores::{Stores, lock},
    sync::at_most,
};

/// Entries in a report from another node, at most: those that are told apart, and as many without a destination.
const REPORTED_MAX: usize = 32;
/// Bytes of a client's report beside its entries, of a whole entry, and of one without what may be left out, at most.
const FRAME_BYTES: usize = 12;
const ENTRY_BYTES: usize = 176;
const SHORT_ENTRY_BYTES: usize = 49;

/// Payload of GNCL_UNDELIVERED: messages of the receiver's applications that applications of the sender's node refused. spec: GNCL-20
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Report {
    #[serde(deserialize_with = "at_most::<_, _, REPORTED_MAX>")]
    pub(crate) entries: Vec<Reported>,
}

/// Those of one source to one destination, of one type, for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Reported {
    /// Application of the receiver's node that has sent them.
    from: AppAddress,
    /// 64 bits of the destination's TID; 0: several.
    to: u64,
    /// Code of the outcome that each of them would have had.
    why: u8,
    count: u64,
    #[serde(default)]
    kind: Option<Kind>,
    #[serde(default)]
    class: Option<Class>,
    #[serde(default)]
    first: Option<u64>,
    #[serde(default)]
    last: Option<u64>,
}

impl Report {
    fn of(entries: &[Entry]) -> Self {
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
        Self { entries: reported.collect() }
    }

    /// Notes what `node` says that it has refused. Only what it can have refused counts: messages to it, to a group, or to all.
    pub(crate) fn note(self, stores: &Stores, node: NodeAddress, now: Time) {
        for said in self.entries {
            let destination = Tid::from_bits(said.to);
            let is_its = destination == Tid::NONE || [node, NodeAddress::ALL].contains(&destination.node);
            if said.count == 0 || !is_its {
                let detail = format!("node {node} reports messages to {destination} as not delivered");
                stores.gncl.refusals.count(now, "report of another node's messages", &detail);
                continue;
            }
            let entry = Entry {
                source: said.from,
                destination,
                kind: said.kind,
                class: said.class,
                why: reason_of(said.why),
                count: said.count,
                since: now,
                first: said.first,
                last: said.last,
            };
            // Who is not there is told nothing, and takes no place in the table.
            if lock(&stores.registry).owner_of(said.from).is_some() {
                stores.undelivered.count(now, entry);
            }
        }
    }
}

/// The reason with this code. One that a later version added is a refusal that this one has no word for.
pub(crate) fn reason_of(code: u8) -> Rejection {
    match Outcome::from_code(code) {
        Some(Outcome::Rejected(why)) => why,
        Some(_) | None => Rejection::Unsupported,
    }
}

/// Reports all that is due at `now`. For LNCL's thread, without a lock in hand.
pub(crate) fn report(stores: &Stores, now: Time) {
    let payload_max = stores.config.payload_max;
    let whole = payload_max.saturating_sub(FRAME_BYTES) / ENTRY_BYTES;
    let short = (payload_max.saturating_sub(FRAME_BYTES) / SHORT_ENTRY_BYTES).max(1);
    let form = if whole > 0 { Form::Whole } else { Form::Short };
    let due = {
        let mut core = lock(&stores.undelivered.core);
        core.take(now, if whole > 0 { whole } else { short })
    };
    for (reader, entries) in due {
        match reader {
            // A node that takes none, or is gone, has its senders hear nothing.
            Reader::Node(node) => {
                if let Some(peer) = stores.gncl.peer(node) {
                    peer.report_undelivered(stores.node, &Report::of(&entries));
                }
            }
            Reader::App(app) => tell_app(stores, now, app, entries, form),
        }
    }
    let (unhandled, warned) = {
        let mut core = lock(&stores.undelivered.core);
        (core.unhandled.take_due(now), core.warned.take_due(now))
    };
    unhandled.iter().for_each(|(key, line)| warn_receiver(stores, key, line));
    warned.iter().for_each(|(key, line)| warn_sender(stores, key, line));
}

/// How much of an entry a client is told.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    Whole,
    /// As much as has room in the shortest payload that can be configured.
    Short,
}

fn tell_app(stores: &Stores, now: Time, app: AppAddress, entries: Vec<Entry>, form: Form) {
    let owner = lock(&stores.registry).owner_of(app);
    match owner {
        // It is gone.
        None => {}
        Some(Owner::Client { .. }) => tell_client(stores, now, app, entries, form),
        Some(Owner::Node) if stores.router.subscribes(app, Event::KIND) => {
            for entry in entries {
                let (source, to) = (payload::lncl_of(stores.node), Tid::new(stores.node, app));
                let event = Message::typed(source, to, &event_of(stores, &entry));
                again_if_full(stores, now, stores.router.tell(app, event), [entry]);
            }
        }
        Some(Owner::Node) => {
            let mut core = lock(&stores.undelivered.core);
            for entry in entries {
                let key = (app, entry.destination, entry.kind, Outcome::Rejected(entry.why).code());
                core.warned.note(now, key, entry.count, entry);
            }
        }
    }
}

// spec: LNCL-14
fn tell_client(stores: &Stores, now: Time, app: AppAddress, entries: Vec<Entry>, form: Form) {
    let said = entries.iter().map(|entry| {
        let event = event_of(stores, entry);
        let mut said = payload::UndeliveredEntry {
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
            (said.kind, said.class, said.name) = (event.kind, event.class, event.name);
            (said.first, said.last) = (event.first_sequence, event.last_sequence);
        }
        said
    });
    let said = payload::Undelivered { entries: said.collect() };
    let (source, to) = (payload::lncl_of(stores.node), Tid::new(stores.node, app));
    let frame = payload::frame(Kind::LNCL_UNDELIVERED, source, to, &said);
    again_if_full(stores, now, stores.router.tell(app, frame), entries);
}

/// One that takes nothing now is told later, with what comes until then.
fn again_if_full(
    stores: &Stores,
    now: Time,
    told: Result<(), Refused>,
    entries: impl IntoIterator<Item = Entry>,
) {
    if matches!(told, Err(Refused { why: Rejection::QueueFull, .. })) {
        let mut core = lock(&stores.undelivered.core);
        for entry in entries {
            core.add(now, Reader::App(entry.source), entry);
        }
    }
}

fn event_of(stores: &Stores, entry: &Entry) -> Event {
    Event {
        destination: entry.destination,
        name: name_of(stores, entry.destination),
        kind: entry.kind,
        class: entry.class,
        why: entry.why,
        count: entry.count,
        since: entry.since,
        first_sequence: entry.first,
        last_sequence: entry.last,
    }
}

/// The name of an application, on any node, if it is known.
fn name_of(stores: &Stores, tid: Tid) -> Option<String> {
    if tid.node == stores.node {
        return lock(&stores.registry).own_name_of(tid.app);
    }
    let directory = lock(&stores.sync).directory();
    directory.into_iter().find(|entry| entry.tid == tid).map(|entry| entry.name)
}

/// A TID with its name, for people.
fn in_words(stores: &Stores, tid: Tid) -> String {
    match name_of(stores, tid) {
        Some(name) => format!("{name} ({tid})"),
        None => tid.to_string(),
    }
}

/// The name of a type, for people.
fn type_in_words(stores: &Stores, kind: Option<Kind>) -> String {
    let Some(kind) = kind else { return "several types".to_owned() };
    kind_name(stores, kind).unwrap_or_else(|| format!("kind {kind}"))
}

/// The name of a type, where an application of this node has said it, or this process sends or handles it.
pub(crate) fn kind_name(stores: &Stores, kind: Kind) -> Option<String> {
    let named = lock(&stores.registry).kind_name(kind).map(str::to_owned);
    named.or_else(|| kind.type_name().map(str::to_owned))
}

/// What makes a receiver handle a type.
pub(crate) fn remedy(app: AppAddress, kind: Kind) -> String {
    if app.is_layer() {
        return "it is a part of its node and handles none of the program's types; is the destination right?"
            .to_owned();
    }
    let name = kind.rust_name().unwrap_or("T");
    format!("add `.handles::<{name}>()` to its AppSpec and implement `Handler<Delivery<{name}>>`")
}

fn warn_receiver(stores: &Stores, key: &Unhandled, line: &Line<Tid>) {
    let &(app, kind, why) = key;
    // Of what cannot be read the application itself has logged what is wrong.
    if why != Outcome::Rejected(Rejection::UnknownKind).code() {
        return;
    }
    let receiver = in_words(stores, Tid::new(stores.node, app));
    let sender = in_words(stores, line.about);
    let named = kind_name(stores, kind);
    let kind_name = named.unwrap_or_else(|| format!("kind {kind} (the log of its sender names it)"));
    let (messages, remedy) = (line.unlogged, remedy(app, kind));
    crate::log::warn!(messages, "{receiver} does not handle {kind_name}, sent by {sender}: {remedy}");
}

fn warn_sender(stores: &Stores, key: &Warned, line: &Line<Entry>) {
    let (sender, messages) = (in_words(stores, Tid::new(stores.node, key.0)), line.unlogged);
    let Entry { destination, kind, why, .. } = line.about;
    let kind = type_in_words(stores, kind);
    let to = if destination == Tid::NONE {
        "several destinations".to_owned()
    } else {
        in_words(stores, destination)
    };
    if is_of_an_end(why) {
        crate::log::info!(messages, "{kind} that {sender} sent to {to} was not delivered: {why}");
    } else {
        crate::log::warn!(messages, "{kind} that {sender} sent to {to} was not delivered: {why}");
    }
}

/// Whether the reason is that an application has ended or restarts: an ordinary stop has such refusals too, and warns of nothing.
pub(crate) const fn is_of_an_end(why: Rejection) -> bool {
    matches!(why, Rejection::Closed | Rejection::Down)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sinew_runtime::{
        mailbox::Mailbox,
        tid::Incarnation,
        wire::{Header, decode, encode},
    };

    use super::*;
    use crate::{
        NodeConfig,
        lncl::{LocalApp, register_local},
    };

    fn said(from: AppAddress, to: Tid, count: u64) -> Reported {
        let why = Outcome::Rejected(Rejection::UnknownKind).code();
        Reported { from, to: to.bits(), why, count, kind: None, class: None, first: None, last: None }
    }

    // spec: GNCL-20
    #[test]
    fn a_peer_reports_its_own_refusals_to_applications_that_are_there_and_no_others() {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let app = LocalApp {
            name: Some("hip".to_owned()),
            address: None,
            requires: vec![],
            kinds: vec![],
            outlet: Mailbox::new(1),
            events: Arc::new([]),
        };
        let hip = register_local(&stores, app).expect("nothing is in the way").app;
        let [peer, other] = [9, 10].map(NodeAddress::new);
        let knee = |node| Tid::new(node, AppAddress::new(0x1001));
        let absent = AppAddress::fixed(7).expect("in the range");
        let entries = vec![
            said(hip, knee(peer), 3),
            said(hip, knee(other), 1),
            said(hip, knee(stores.node), 1),
            said(hip, knee(peer), 0),
            said(absent, knee(peer), 1),
        ];
        Report { entries }.note(&stores, peer, Time::ZERO);
        assert_eq!(stores.gncl.refusals.of("report of another node's messages"), 3);
        let due = lock(&stores.undelivered.core).take(Time::ZERO, usize::MAX);
        let [(Reader::App(reader), kept)] = &due[..] else { panic!("{due:?}") };
        assert_eq!((*reader, kept.len(), kept[0].count), (hip, 1, 3));
    }

    // spec: GNCL-20
    #[test]
    fn a_longer_report_than_there_may_be_is_refused() {
        let app = AppAddress::new(0x1001);
        let report = |entries| Report { entries: vec![said(app, Tid::NONE, 1); entries] };
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
        let report = Report::of(&[entry; 2 * REPORTED_MAX]);
        assert_eq!(report.entries.len(), REPORTED_MAX);
        assert!(encode(&report).len() <= 4_096, "as long as a frame of GNCL itself may be");
    }
}
