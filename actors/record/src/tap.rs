//! Writes each selected message into the journal, on its sender's thread, and each outcome, on the thread that settles
//! the message: no lock, no allocation, no wait.

use std::sync::Arc;

use sinew_runtime::{
    outcome::{Outcome, OutcomeObserver, Ticket},
    router::tap::{Passage, Tap, Way},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind},
};
use sinew_shm::journal::Journal;

use crate::{Channel, Chosen, Form, OutcomeEntry, message_head};

/// The entry of the routing table while the node records.
pub struct RecordTap {
    node: NodeAddress,
    journal: Arc<Journal>,
    chosen: Chosen,
}

impl RecordTap {
    /// Creates the tap of the node at this address.
    #[must_use]
    pub const fn new(node: NodeAddress, journal: Arc<Journal>, chosen: Chosen) -> Self {
        Self { node, journal, chosen }
    }

    /// Returns whether the message has a record at its sender.
    fn has_sender(&self, header: &Header) -> bool {
        let Header { source, destination, kind, .. } = *header;
        self.watches(source)
            && (self.chosen.has(source, destination, kind) || self.chosen.has(source, source, kind))
    }

    /// Returns the form of the record, or `None` if the message has one already: a message between two applications of
    /// this node passes once for each of them.
    fn form(&self, passage: &Passage<'_>) -> Option<Form> {
        match passage.way {
            Way::Out => Some(Form::Sent),
            Way::In if !self.has_sender(passage.header) => Some(Form::Received),
            // The record of the sender has no result of each member of a group.
            Way::In if passage.refused.is_some() && !passage.header.destination.is_single() => {
                Some(Form::Received)
            }
            Way::In => None,
        }
    }
}

impl Tap for RecordTap {
    fn watches(&self, app: Tid) -> bool {
        app.node == self.node && (self.chosen.has_groups() || self.chosen.has_app(app))
    }

    fn saw(&self, app: Tid, passage: &Passage<'_>) {
        let Passage { header, payload, length, refused, .. } = *passage;
        let (source, destination) = (header.source, header.destination);
        // A program that reads a recording must not fill the ring with its own questions, nor must the nodes with the
        // states of the stop that they exchange: a press is in the log, and is a trigger.
        let is_stop = source.app == AppAddress::STOP && destination.app == AppAddress::STOP;
        if is_inspection(source, destination) || is_stop {
            return;
        }
        if !self.chosen.has(source, destination, header.kind) && !self.chosen.has(app, app, header.kind) {
            return;
        }
        let Some(form) = self.form(passage) else { return };
        // Each member of a group has a channel of its own; the header names the group.
        let destination = if form == Form::Received { app } else { destination };
        let channel = Channel { source, destination, kind: header.kind, class: header.class, form, refused };
        let head = message_head(form, header, length, refused);
        let payload = if payload.len() == length { &payload[..] } else { &[] };
        self.journal.write(channel.key(), Time::now().as_nanos(), &[&head, payload]);
    }

    fn missed(&self, app: Tid, messages: u64) {
        self.journal.count(lost_channel(app).key(), messages);
    }
}

/// Returns whether it is a question to the inspection of a node, or its answer. A program that reads a recording must
/// not fill the ring with its own questions.
fn is_inspection(source: Tid, destination: Tid) -> bool {
    [source, destination].iter().any(|party| party.app == AppAddress::INSPECT)
}

/// The observer of outcomes while the node records: those of confirmed messages that applications of this node sent.
///
/// The types of their messages are not known here, so a selection of types does not limit them.
pub struct OutcomeTap {
    node: NodeAddress,
    journal: Arc<Journal>,
    chosen: Chosen,
}

impl OutcomeTap {
    /// Creates the observer of the node at this address.
    #[must_use]
    pub const fn new(node: NodeAddress, journal: Arc<Journal>, chosen: Chosen) -> Self {
        Self { node, journal, chosen }
    }
}

impl OutcomeObserver for OutcomeTap {
    fn settled(&self, ticket: Ticket, outcome: Outcome) {
        let Ticket { source, destination, .. } = ticket;
        // Other nodes of this process have observers of their own.
        let is_own = source.node == self.node;
        if !is_own || is_inspection(source, destination) || !self.chosen.has_ends(source, destination) {
            return;
        }
        let (key, record) =
            (Channel::of_node(self.node, Form::Outcome).key(), OutcomeEntry { ticket, outcome });
        self.journal.write(key, Time::now().as_nanos(), &[&record.record()]);
    }
}

/// The channel that counts messages of an application which its process could not report.
#[must_use]
pub const fn lost_channel(app: Tid) -> Channel {
    Channel {
        source: app,
        destination: Tid::NONE,
        kind: Kind::from_bits(0),
        class: Class::Control,
        form: Form::Sent,
        refused: None,
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use bytes::Bytes;
    use sinew_runtime::outcome::Rejection;
    use sinew_shm::journal::{JournalReader, Options, Start};

    use super::*;
    use crate::{Entry, MessageEntry, Selection};

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

    fn tid(app: u32) -> Tid {
        Tid::new(NODE, AppAddress::new(app))
    }

    /// A journal of a test, which is removed at the end.
    struct Bench {
        path: PathBuf,
        tap: RecordTap,
    }

    impl Bench {
        fn new(name: &str, selection: &Selection, apps: &[(&str, Tid)]) -> Self {
            let path = std::env::temp_dir().join(format!("sinew-tap-{name}-{}.journal", std::process::id()));
            let options = Options { ring_bytes: 64 * 1024, ..Options::default() };
            let journal = Arc::new(Journal::create(&path, &options).expect("it is made"));
            let chosen = selection.chosen(apps.iter().copied(), []);
            Self { path, tap: RecordTap::new(NODE, journal, chosen) }
        }

        fn show(&self, app: Tid, way: Way, header: &Header, refused: Option<Rejection>) {
            let payload = Bytes::from_static(&[1, 2, 3]);
            if self.tap.watches(app) {
                self.tap.saw(app, &Passage { way, header, payload: &payload, length: 3, refused });
            }
        }

        /// Returns form, destination and rejection of each record.
        fn records(&self) -> Vec<(Form, Tid, Option<Rejection>)> {
            let mut reader = JournalReader::open(&self.path, Start::Oldest).expect("it is there");
            let (mut bytes, mut records) = (Vec::new(), Vec::new());
            while let Some(record) = reader.next(0, &mut bytes).expect("it is whole") {
                let channels = reader.channels().expect("it is there");
                let place = channels.iter().find(|channel| channel.place == record.place).expect("a place");
                let channel = Channel::of(place.key.expect("a key")).expect("a channel");
                let Ok(Entry::Message(MessageEntry { form, payload, refused, .. })) = Entry::read(&bytes)
                else {
                    panic!("no message")
                };
                assert_eq!((channel.form, channel.refused, payload), (form, refused, Some(&[1, 2, 3][..])));
                records.push((form, channel.destination, refused));
            }
            records
        }
    }

    impl Drop for Bench {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.path);
        }
    }

    fn header(source: Tid, destination: Tid) -> Header {
        Header::new(Kind::named("test.any"), source, destination)
    }

    #[test]
    fn message_within_the_node_has_one_record() {
        let bench = Bench::new("once", &Selection::default(), &[]);
        let within = header(tid(0x1001), tid(0x1002));
        bench.show(tid(0x1001), Way::Out, &within, None);
        bench.show(tid(0x1002), Way::In, &within, None);
        let elsewhere = Tid::new(NodeAddress::new(9), AppAddress::new(0x1001));
        bench.show(tid(0x1002), Way::In, &header(elsewhere, tid(0x1002)), None);
        let full = Some(Rejection::QueueFull);
        bench.show(tid(0x1001), Way::Out, &header(tid(0x1001), elsewhere), full);
        let expected = [
            (Form::Sent, tid(0x1002), None),
            (Form::Received, tid(0x1002), None),
            (Form::Sent, elsewhere, full),
        ];
        assert_eq!(bench.records(), expected);
    }

    #[test]
    fn member_that_rejects_a_group_message_is_recorded() {
        let bench = Bench::new("group", &Selection::default(), &[]);
        let to_group = header(tid(0x1001), Tid::group("knees"));
        bench.show(tid(0x1001), Way::Out, &to_group, None);
        bench.show(tid(0x1002), Way::In, &to_group, None);
        bench.show(tid(0x1003), Way::In, &to_group, Some(Rejection::QueueFull));
        let expected = [
            (Form::Sent, Tid::group("knees"), None),
            (Form::Received, tid(0x1003), Some(Rejection::QueueFull)),
        ];
        assert_eq!(bench.records(), expected);
    }

    #[test]
    fn inspection_has_no_records() {
        let bench = Bench::new("inspection", &Selection::default(), &[]);
        let (app, inspection) = (tid(0x1001), Tid::new(NODE, AppAddress::INSPECT));
        let elsewhere = Tid::new(NodeAddress::new(9), AppAddress::INSPECT);
        bench.show(app, Way::Out, &header(app, inspection), None);
        bench.show(app, Way::In, &header(inspection, app), None);
        bench.show(app, Way::Out, &header(app, elsewhere), None);
        bench.show(app, Way::Out, &header(app, tid(0x1002)), None);
        assert_eq!(bench.records(), [(Form::Sent, tid(0x1002), None)]);
    }

    #[test]
    fn only_selected_messages_are_recorded() {
        let selection = Selection {
            apps: vec!["knee".to_owned()],
            types: vec!["test.any".to_owned()],
            ..Selection::default()
        };
        let bench = Bench::new("selected", &selection, &[("knee", tid(0x1002)), ("hip", tid(0x1001))]);
        let to_knee = header(tid(0x1001), tid(0x1002));
        bench.show(tid(0x1001), Way::Out, &to_knee, None);
        bench.show(tid(0x1002), Way::In, &to_knee, None);
        bench.show(tid(0x1002), Way::Out, &Header { kind: Kind::named("test.other"), ..to_knee }, None);
        bench.show(tid(0x1002), Way::Out, &header(tid(0x1002), tid(0x1003)), None);
        let expected = [(Form::Received, tid(0x1002), None), (Form::Sent, tid(0x1003), None)];
        assert_eq!(bench.records(), expected);
    }

    #[test]
    fn outcomes_of_own_messages_are_recorded() {
        let selection = Selection { apps: vec!["knee".to_owned()], ..Selection::default() };
        let bench = Bench::new("outcomes", &selection, &[("knee", tid(0x1002))]);
        let RecordTap { node, journal, chosen } = &bench.tap;
        let tap = OutcomeTap::new(*node, journal.clone(), chosen.clone());
        let elsewhere = Tid::new(NodeAddress::new(9), AppAddress::new(0x1002));
        let show = |source, destination| {
            tap.settled(Ticket { source, destination, correlation: 7 }, Outcome::PeerLost);
        };
        show(tid(0x1001), tid(0x1002));
        show(tid(0x1001), tid(0x1003));
        show(elsewhere, tid(0x1002));
        show(tid(0x1002), Tid::new(NODE, AppAddress::INSPECT));
        show(tid(0x1002), elsewhere);
        let mut reader = JournalReader::open(&bench.path, Start::Oldest).expect("it is there");
        let (mut bytes, mut found) = (Vec::new(), Vec::new());
        while reader.next(0, &mut bytes).expect("it is whole").is_some() {
            let Ok(Entry::Outcome(entry)) = Entry::read(&bytes) else { panic!("no outcome") };
            assert_eq!((entry.ticket.correlation, entry.outcome), (7, Outcome::PeerLost));
            found.push((entry.ticket.source, entry.ticket.destination));
        }
        assert_eq!(found, [(tid(0x1001), tid(0x1002)), (tid(0x1002), elsewhere)]);
        let channels = reader.channels().expect("it is there");
        let seen: Vec<_> = channels.iter().map(|channel| (channel.key, channel.seen)).collect();
        assert_eq!(seen, [(Some(Channel::of_node(NODE, Form::Outcome).key()), 2)]);
    }

    #[test]
    fn unreported_messages_are_counted() {
        let bench = Bench::new("missed", &Selection::default(), &[]);
        bench.tap.missed(tid(0x1001), 4);
        bench.tap.missed(tid(0x1001), 3);
        let reader = JournalReader::open(&bench.path, Start::Oldest).expect("it is there");
        let channels = reader.channels().expect("it is there");
        let found: Vec<_> = channels.iter().map(|channel| (channel.key, channel.seen)).collect();
        assert_eq!(found, [(Some(lost_channel(tid(0x1001)).key()), 7)]);
    }
}
