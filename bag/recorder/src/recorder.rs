//! Reads the journal, and writes the file.

mod state;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_bag::{BagError, BagWriter, Totals};
use sinew_record::{Channel, Entry, Form, MessageEntry, PeerClock};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::Kind,
};
use sinew_shm::journal::{self, JournalReader, ReadJournalError};

use crate::{
    channels::{Description, Held, Place, Recorded, is_unreported, record},
    facts,
    names::Names,
    setup::Setup,
    sink::Sink,
    span::Span,
};

/// Time that a record may stay unfinished: its writer may have been preempted.
const PATIENCE: Duration = Duration::from_millis(20);
/// Time for which messages wait for one with a lower number, once the journal was read to its end.
const HELD_NS: u64 = 100_000_000;
/// Maximum bytes of all held messages. Beyond it the missing ones are not awaited.
const HELD_BYTES_MAX: usize = 16 << 20;
/// Maximum records of one call.
const RECORDS_MAX: usize = 4_096;
/// Maximum payload types, and maximum applications, for which a message waits. Further ones have the name that is known
/// by then.
const WAITED_MAX: usize = 4_096;
/// Time between two tallies.
const TALLY_NS: u64 = 1_000_000_000;

/// Records a node: reads its journal, and writes the file.
///
/// For each channel seen = written + dropped. The numbers in the journal say how many messages were seen: those after
/// the number at which the recording began. A number is counted as dropped once it is missing: a record with a number
/// that is higher by [`WINDOW`](crate::WINDOW) is there, or 100 ms have passed after the end of the journal was read. A
/// message that comes even later is in no file.
///
/// Faults of the file do not stop it: [`take_fault`](Self::take_fault). All times are nanoseconds of the host's
/// monotonic clock.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew_bag::{BagWriter, Options, Origin};
/// use sinew_record::Selection;
/// use sinew_recorder::{JournalReader, Names, Recorder, Setup, Start};
/// use sinew_runtime::{tid::NodeAddress, time::Time};
///
/// let reader = JournalReader::open(Path::new("/dev/shm/sinew-walker-10.0.0.2.journal"), Start::Newest)?;
/// let bag = BagWriter::create("walk.mcap", Options::default(), Origin::default())?;
/// let node = NodeAddress::from([10, 0, 0, 2]);
/// let setup = Setup { node, selection: Selection::default(), names: Names::default(), left_out: vec![] };
/// let mut recorder = Recorder::begin(reader, bag, setup)?;
/// while recorder.is_writer_alive() {
///     if recorder.pump(Time::now().as_nanos())? {
///         std::thread::sleep(std::time::Duration::from_millis(5));
///     }
/// }
/// recorder.stop()?;
/// while !recorder.pump(Time::now().as_nanos())? {}
/// let totals = recorder.finish(Time::now().as_nanos())?;
/// assert_eq!(totals.seen, totals.written + totals.dropped);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Recorder {
    reader: JournalReader,
    sink: Sink,
    setup: Setup,
    /// The number of the last record before the recording began, by place.
    before: BTreeMap<u16, u64>,
    /// The number of the last record before the end, by place.
    until: Option<BTreeMap<u16, u64>>,
    /// The channels of the table, as far as they are known.
    channels: BTreeMap<u16, Channel>,
    places: BTreeMap<u16, Place>,
    /// Facts and outcomes that were read, by place.
    facts: BTreeMap<u16, u64>,
    held_bytes: usize,
    /// The last record that was read.
    buffer: Vec<u8>,
    /// The record in the buffer, if it waits for names or for the structure of its payload type.
    waiting: Option<(journal::Record, Kind)>,
    /// The types for which a record has waited.
    waited_types: BTreeSet<Kind>,
    /// The applications for which a record has waited.
    waited_apps: BTreeSet<Tid>,
    tally_due_ns: u64,
}

impl Recorder {
    /// Begins with the next message. `reader` was opened before, with [`Start::Newest`](crate::Start::Newest).
    ///
    /// # Errors
    /// The journal cannot be read.
    pub fn begin(reader: JournalReader, bag: BagWriter, setup: Setup) -> Result<Self, ReadJournalError> {
        Self::begin_with(reader, Sink::new(bag), setup)
    }

    fn begin_with(mut reader: JournalReader, sink: Sink, setup: Setup) -> Result<Self, ReadJournalError> {
        reader.set_patience(PATIENCE);
        // A message with a higher number is written to the ring later than this, and so is read.
        let before = seen(&reader.channels()?);
        Ok(Self::new(reader, sink, setup, before))
    }

    const fn new(reader: JournalReader, sink: Sink, setup: Setup, before: BTreeMap<u16, u64>) -> Self {
        Self {
            reader,
            sink,
            setup,
            before,
            until: None,
            channels: BTreeMap::new(),
            places: BTreeMap::new(),
            facts: BTreeMap::new(),
            held_bytes: 0,
            buffer: Vec::new(),
            waiting: None,
            waited_types: BTreeSet::new(),
            waited_apps: BTreeSet::new(),
            tally_due_ns: 0,
        }
    }

    /// Begins with the records of a span, of a journal without a living writer. `reader` was opened with
    /// [`Start::Oldest`](crate::Start::Oldest). Call [`pump`](Self::pump) until it has no more, then
    /// [`finish`](Self::finish).
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::path::Path;
    ///
    /// use sinew_bag::{BagWriter, Options, Origin};
    /// use sinew_record::Selection;
    /// use sinew_recorder::{JournalReader, Names, Recorder, Setup, Span, Start};
    /// use sinew_runtime::tid::NodeAddress;
    ///
    /// let path = Path::new("/dev/shm/sinew-walker-10.0.0.2.journal");
    /// let span = Span::scan(path, &(0..=u64::MAX))?;
    /// let bag = BagWriter::create("knee.mcap", Options::default(), Origin::default())?;
    /// let node = NodeAddress::from([10, 0, 0, 2]);
    /// let setup = Setup { node, selection: Selection::default(), names: Names::default(), left_out: vec![] };
    /// let mut recorder = Recorder::of_span(JournalReader::open(path, Start::Oldest)?, bag, setup, &span);
    /// while !recorder.pump(span.last_ns)? {}
    /// recorder.finish(span.last_ns)?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn of_span(mut reader: JournalReader, bag: BagWriter, setup: Setup, span: &Span) -> Self {
        // No writer finishes a record any more.
        reader.set_patience(Duration::ZERO);
        Self { until: Some(span.until()), ..Self::new(reader, Sink::new(bag), setup, span.before()) }
    }

    /// Writes the records that are there, at most 4,096, and each second the counters. Returns whether there are no
    /// more for now. To be called every few milliseconds: the journal keeps only the newest bytes. It returns early at
    /// the first message of a channel, if something is not known of it: see [`is_waiting`](Self::is_waiting).
    ///
    /// # Errors
    /// The journal cannot be read. After [`ReadJournalError::Damaged`] the next call continues.
    pub fn pump(&mut self, now_ns: u64) -> Result<bool, ReadJournalError> {
        let mut bytes = std::mem::take(&mut self.buffer);
        let read = self.read(now_ns, &mut bytes);
        self.buffer = bytes;
        let is_empty = read?;
        if is_empty && self.held_bytes > 0 {
            self.give_up_before(now_ns.saturating_sub(HELD_NS));
        }
        if now_ns >= self.tally_due_ns {
            self.tally_due_ns = now_ns.saturating_add(TALLY_NS);
            self.count_unreported(now_ns)?;
            self.sink.tally(now_ns);
        }
        Ok(is_empty)
    }

    /// Sets the end: messages that the node sees from now on are not recorded. Those before may still be on their way
    /// into the ring, so [`pump`](Self::pump) is called until [`is_drained`](Self::is_drained), for 200 ms at most.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub fn stop(&mut self) -> Result<(), ReadJournalError> {
        let table = self.read_table()?;
        self.until.get_or_insert_with(|| seen(&table));
        Ok(())
    }

    /// Returns whether all messages before [`stop`](Self::stop) were read or counted.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        self.until.as_ref().is_some_and(|until| until.iter().all(|(place, seen)| self.has_all(*place, *seen)))
    }

    /// Counts the messages that were not read, and finishes the file.
    ///
    /// # Errors
    /// The end of the file cannot be written. It can be read up to its last chunk.
    pub fn finish(mut self, now_ns: u64) -> Result<Totals, BagError> {
        // Where the journal cannot be read any more, the numbers that were read are the last known ones.
        let _ = self.stop();
        self.give_up_before(u64::MAX);
        let (mut lost, mut lost_outcomes) = (0, 0);
        for (place, seen) in self.until.take().unwrap_or_default() {
            let form = self.channels.get(&place).map(|channel| channel.form);
            if form.is_none_or(Form::is_message) {
                self.catch_up(place, seen, now_ns);
                continue;
            }
            let read = self.facts.get(&place).copied().unwrap_or(0);
            let of_form = if form == Some(Form::Outcome) { &mut lost_outcomes } else { &mut lost };
            *of_form += seen.saturating_sub(self.before(place)).saturating_sub(read);
        }
        facts::lost(&mut self.sink, now_ns, lost, lost_outcomes);
        self.sink.finish(now_ns)
    }

    /// Returns whether the next message is the first one of a channel, and names of it or the structure of its type are
    /// not known. The next call of [`pump`](Self::pump) writes it in any case. Its channel has the names and the
    /// structure that are known by then, so the owner can ask the node before. No message waits twice for a type or for
    /// an application.
    #[must_use]
    pub const fn is_waiting(&self) -> bool {
        self.waiting.is_some()
    }

    /// Returns at most `count` payload types of the journal without a known structure: first that of the message that
    /// waits.
    #[must_use]
    pub fn wanted(&self, count: usize) -> Vec<Kind> {
        let first = self.waiting.map(|(_, kind)| kind);
        let messages = self.channels.values().filter(|channel| channel.form.is_message());
        let others: BTreeSet<_> = messages.map(|channel| channel.kind).collect();
        let others = others.into_iter().filter(|kind| Some(*kind) != first);
        let all = first.into_iter().chain(others);
        all.filter(|kind| !self.setup.names.is_settled(*kind)).take(count).collect()
    }

    /// Returns the names, to which the owner adds. A channel keeps the names that it has at its first message.
    pub const fn names_mut(&mut self) -> &mut Names {
        &mut self.setup.names
    }

    /// Writes the clocks of other nodes. Those in the journal are written by [`pump`](Self::pump).
    pub fn clocks(&mut self, now_ns: u64, peers: &[PeerClock]) {
        facts::clocks(&mut self.sink, now_ns, peers, &self.setup.names);
    }

    fn before(&self, place: u16) -> u64 {
        self.before.get(&place).copied().unwrap_or(0)
    }

    /// Whether a record belongs to the time of the recording.
    fn is_within(&self, place: u16, number: u64) -> bool {
        let until = self.until.as_ref().map(|until| until.get(&place).copied().unwrap_or(0));
        number > self.before(place) && until.is_none_or(|until| number <= until)
    }

    fn has_all(&self, place: u16, seen: u64) -> bool {
        let channel = self.channels.get(&place);
        // Nothing in the ring belongs to a counter of unreported messages, and facts are counted at the end.
        if channel.is_some_and(|channel| !channel.form.is_message() || is_unreported(channel)) {
            return true;
        }
        match self.places.get(&place) {
            Some(Place::Recorded(recorded)) => recorded.order.last() >= seen,
            Some(Place::Unchosen { .. }) => true,
            None => seen <= self.before(place),
        }
    }

    fn read(&mut self, now_ns: u64, bytes: &mut Vec<u8>) -> Result<bool, ReadJournalError> {
        if let Some((found, _)) = self.waiting.take()
            && let Ok(entry) = Entry::read(bytes)
        {
            self.take(&found, &entry)?;
        }
        for _ in 0..RECORDS_MAX {
            let Some(found) = self.reader.next(now_ns, bytes)? else { return Ok(true) };
            // A record that cannot be read is missing by its number.
            let Ok(entry) = Entry::read(bytes) else { continue };
            if let Entry::Message(message) = &entry
                && self.awaits(&found, message.header.kind)?
            {
                self.waiting = Some((found, message.header.kind));
                return Ok(false);
            }
            self.take(&found, &entry)?;
        }
        Ok(false)
    }

    /// Whether the first message of a channel waits for names, or for the structure of its type.
    fn awaits(&mut self, found: &journal::Record, kind: Kind) -> Result<bool, ReadJournalError> {
        if self.places.contains_key(&found.place) || !self.is_within(found.place, found.number) {
            return Ok(false);
        }
        self.read_table()?;
        let Setup { names, left_out, .. } = &self.setup;
        let ends = self.channels.get(&found.place).map(|channel| [channel.source, channel.destination]);
        let ends = ends.unwrap_or([Tid::NONE; 2]);
        if ends.iter().any(|app| left_out.contains(app)) {
            return Ok(false);
        }
        let mut awaits =
            self.waited_types.len() < WAITED_MAX && !names.is_settled(kind) && self.waited_types.insert(kind);
        for app in ends {
            let is_named = !app.is_single() || app.app.is_layer() || names.app(app).is_some();
            awaits |= !is_named && self.waited_apps.len() < WAITED_MAX && self.waited_apps.insert(app);
        }
        Ok(awaits)
    }

    pub(crate) fn take(
        &mut self,
        found: &journal::Record,
        entry: &Entry<'_>,
    ) -> Result<(), ReadJournalError> {
        let is_within = self.is_within(found.place, found.number);
        if let Entry::Message(message) = entry {
            return if is_within { self.message(found, message) } else { Ok(()) };
        }
        if let Entry::Node(fact) = entry {
            facts::learn(&mut self.setup.names, fact);
        }
        if !is_within {
            return Ok(());
        }
        *self.facts.entry(found.place).or_default() += 1;
        match entry {
            Entry::Node(fact) => facts::node(&mut self.sink, found.time, fact),
            Entry::Clock(fact) => {
                facts::clocks(&mut self.sink, found.time, &fact.peers, &self.setup.names);
            }
            Entry::Log(fact) => facts::log(&mut self.sink, found.time, fact),
            Entry::Outcome(entry) if self.setup.chooses_outcome(entry.ticket) => {
                facts::outcome(&mut self.sink, found.time, entry, &self.setup.names);
            }
            Entry::Outcome(_) => {}
            Entry::Message(_) => {}
        }
        Ok(())
    }

    fn message(
        &mut self,
        found: &journal::Record,
        message: &MessageEntry<'_>,
    ) -> Result<(), ReadJournalError> {
        self.know(found, message)?;
        let Some(Place::Recorded(recorded)) = self.places.get_mut(&found.place) else { return Ok(()) };
        let record = record(found.number, found.time, message);
        if recorded.order.pass(found.number) {
            recorded.write(&mut self.sink, &record, message.payload);
        } else {
            let held = Held::new(record, message.payload);
            let bytes = held.bytes();
            // One that was counted as dropped already is in no file.
            if recorded.order.hold(found.number, held).is_ok() {
                self.held_bytes += bytes;
            }
        }
        let gives_up = self.held_bytes > HELD_BYTES_MAX;
        self.held_bytes -= recorded.release(&mut self.sink, gives_up);
        Ok(())
    }

    /// Decides about a channel at its first message, and once more after names have changed.
    fn know(&mut self, found: &journal::Record, message: &MessageEntry<'_>) -> Result<(), ReadJournalError> {
        let before = match self.places.get(&found.place) {
            Some(Place::Recorded(_)) => return Ok(()),
            Some(Place::Unchosen { changes }) if *changes == self.setup.names.changes() => return Ok(()),
            // Those before were not chosen.
            Some(Place::Unchosen { .. }) => found.number.saturating_sub(1),
            None => self.before(found.place),
        };
        if !self.channels.contains_key(&found.place) {
            self.read_table()?;
        }
        self.add(found.place, (message.header.destination, message.payload), before, found.time);
        Ok(())
    }

    /// Adds a channel: with the destination and the payload of its first message, if there is one.
    fn add(&mut self, place: u16, (to, first): (Tid, Option<&[u8]>), before: u64, now_ns: u64) {
        let Setup { node, names, .. } = &self.setup;
        let (is_chosen, description) = match self.channels.get(&place) {
            Some(channel) => (self.setup.chooses(channel, to), Description::of(channel, first, *node, names)),
            None => (true, Description::shared()),
        };
        let changes = names.changes();
        let id = if is_chosen { self.sink.channel(&description.info(before)) } else { None };
        let recorded = id.map(|id| Place::Recorded(Recorded::new(id, before, now_ns)));
        self.places.insert(place, recorded.unwrap_or(Place::Unchosen { changes }));
    }

    /// Reads the table of channels.
    fn read_table(&mut self) -> Result<Vec<journal::Channel>, ReadJournalError> {
        let table = self.reader.channels()?;
        let node = self.setup.node;
        let full = |tid: Tid| {
            let is_here = tid.node == NodeAddress::HERE && tid.app != AppAddress::NONE;
            if is_here { Tid::new(node, tid.app) } else { tid }
        };
        for found in &table {
            if let Some(channel) = found.key.and_then(Channel::of) {
                let (source, destination) = (full(channel.source), full(channel.destination));
                self.channels.insert(found.place, Channel { source, destination, ..channel });
            }
        }
        Ok(table)
    }

    /// Counts the messages that the processes of applications could not report to the node.
    fn count_unreported(&mut self, now_ns: u64) -> Result<(), ReadJournalError> {
        for found in self.read_table()? {
            let is_counter = self.channels.get(&found.place).is_some_and(is_unreported);
            if is_counter && self.is_within(found.place, found.seen) {
                self.catch_up(found.place, found.seen, now_ns);
            }
        }
        Ok(())
    }

    /// Counts all messages up to this number as dropped that were not read.
    fn catch_up(&mut self, place: u16, seen: u64, now_ns: u64) {
        let before = self.before(place);
        if seen <= before {
            return;
        }
        if !self.places.contains_key(&place) {
            let to = self.channels.get(&place).map_or(Tid::NONE, |channel| channel.destination);
            self.add(place, (to, None), before, now_ns);
        }
        if let Some(Place::Recorded(recorded)) = self.places.get_mut(&place) {
            recorded.skip_to(&mut self.sink, seen, now_ns);
        }
    }

    /// Does not await the numbers before held messages of this time and earlier.
    fn give_up_before(&mut self, at_ns: u64) {
        for place in self.places.values_mut() {
            let Place::Recorded(recorded) = place else { continue };
            if recorded.order.first_held().is_some_and(|held| held.at_ns() <= at_ns) {
                self.held_bytes -= recorded.release(&mut self.sink, true);
            }
        }
    }
}

/// Returns the number of the last record, by place.
fn seen(table: &[journal::Channel]) -> BTreeMap<u16, u64> {
    table.iter().map(|channel| (channel.place, channel.seen)).collect()
}
