//! The files of a recording as messages in one order.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew_bag::{
    BagError,
    read::{Header, Message, Ordered, OwnedMessage, Role},
};

use crate::{RecordedChannel, channel};

/// The metadata record of a recording.
const METADATA: &str = "sinew";
/// Messages are put into the order in which they were sent as far as they arrived within this time of each other.
const WINDOW_NS: u64 = 1_000_000_000;
/// Maximum number of messages that wait for their place.
const HELD_MAX: usize = 65_536;
/// Maximum bytes of their payloads.
const HELD_BYTES_MAX: usize = 64 << 20;

/// The order of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// As they were sent. Where a file has a message at both ends, the record of its sender counts.
    Sent,
    /// As they arrived. Where a file has a message at both ends, the record of its receiver counts.
    Arrived,
}

/// A message of a recording. Times are in nanoseconds of the file's wall clock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Its channel.
    pub channel: Arc<RecordedChannel>,
    /// The number of its channel in [`Playback::channels`].
    pub index: usize,
    /// The header, as far as the recording has it.
    pub header: Header,
    /// When it was sent.
    pub sent_ns: u64,
    /// When it was handed over.
    pub arrived_ns: u64,
    /// The payload, as it was sent.
    pub payload: Vec<u8>,
}

/// A recording that is read: one file, a merged one, or all parts of one node.
///
/// # Examples
///
/// ```no_run
/// use sinew_player::{Order, Playback};
///
/// let mut playback = Playback::open(&["walk.mcap", "walk.1.mcap"], Order::Sent)?;
/// playback.retain(|channel| channel.source_name.as_deref() == Some("knee.sensor"));
/// while let Some(message) = playback.next_message()? {
///     println!("{} ns: {} bytes", playback.offset_ns(message.sent_ns), message.payload.len());
/// }
/// # Ok::<(), sinew_bag::BagError>(())
/// ```
#[derive(Debug)]
pub struct Playback {
    order: Order,
    files: Vec<Source>,
    channels: Vec<Arc<RecordedChannel>>,
    /// Whether the messages of each channel are wanted.
    is_wanted: Vec<bool>,
    /// The time of the first message of a payload, wanted or not.
    start_ns: Option<u64>,
    is_begun: bool,
    /// Messages that wait for their place, by the time at which they were sent and their number.
    held: BTreeMap<(u64, u64), Recorded>,
    held_bytes: usize,
    /// The number of messages that were read.
    read: u64,
    /// The time up to which the files are read; `None`: to their end.
    read_to_ns: Option<u64>,
    wall_offset_ns: i64,
    node: String,
    damage: Vec<String>,
    missing_ends: Vec<String>,
    /// The request to stop.
    stop: Arc<AtomicBool>,
}

/// One file.
#[derive(Debug)]
struct Source {
    ordered: Ordered,
    /// Its channels of payloads, as places in the list of all channels.
    ids: BTreeMap<u16, usize>,
    /// A message that was read while its predecessor's header was sought.
    ahead: Option<OwnedMessage>,
    next: Option<Recorded>,
}

impl Playback {
    /// Opens all parts of one recording.
    ///
    /// # Errors
    /// A file cannot be read or is no MCAP file, or the files are of several nodes.
    pub fn open<P: AsRef<Path>>(files: &[P], order: Order) -> Result<Self, BagError> {
        let mut playback = Self {
            order,
            files: Vec::new(),
            channels: Vec::new(),
            is_wanted: Vec::new(),
            start_ns: None,
            is_begun: false,
            held: BTreeMap::new(),
            held_bytes: 0,
            read: 0,
            read_to_ns: Some(0),
            wall_offset_ns: 0,
            node: String::new(),
            damage: Vec::new(),
            missing_ends: Vec::new(),
            stop: Arc::default(),
        };
        let (mut known, mut parts, mut origin) = (BTreeMap::new(), BTreeSet::new(), None);
        for path in files {
            let path = path.as_ref();
            let ordered = Ordered::open(path)?;
            let text = |key: &str| {
                let value = ordered.metadata(METADATA).and_then(|fields| fields.get(key));
                value.cloned().unwrap_or_default()
            };
            let own = (text("address"), text("incarnation"), text("began_ns"));
            if origin.get_or_insert_with(|| own.clone()) != &own || !parts.insert(text("part")) {
                let why = "it is no further part of the first file's recording; merge the files of several nodes, \
                           or of several recordings, with `sinew bag merge`";
                return Err(BagError::Unfit(format!("{}: {why}", path.display())));
            }
            playback.wall_offset_ns = text("wall_offset_ns").parse().unwrap_or(0);
            playback.node = own.0;
            playback.damage.extend_from_slice(ordered.damage());
            playback.missing_ends.extend(ordered.missing_end().map(str::to_owned));
            let mut ids = BTreeMap::new();
            for (id, channel) in ordered.channels() {
                let Some(channel) = RecordedChannel::of(channel) else { continue };
                let index = *known.entry(channel.key()).or_insert(playback.channels.len());
                if index == playback.channels.len() {
                    playback.channels.push(Arc::new(channel));
                }
                ids.insert(*id, index);
            }
            playback.files.push(Source { ordered, ids, ahead: None, next: None });
        }
        playback.is_wanted =
            channel::without_copies(playback.channels.iter().map(|channel| &**channel), order);
        Ok(playback)
    }

    /// Returns all channels of payloads.
    #[must_use]
    pub fn channels(&self) -> &[Arc<RecordedChannel>] {
        &self.channels
    }

    /// Returns the address of the recording's node; empty for a merged file.
    #[must_use]
    pub fn node(&self) -> &str {
        &self.node
    }

    /// Returns wall clock minus monotonic clock of the files; 0 for a merged file.
    #[must_use]
    pub const fn wall_offset_ns(&self) -> i64 {
        self.wall_offset_ns
    }

    /// Returns the damage of the files that was found and skipped, a line for each.
    #[must_use]
    pub fn damage(&self) -> &[String] {
        &self.damage
    }

    /// Returns a line for each unfinished file: from which byte and which time on messages may be missing.
    #[must_use]
    pub fn missing_ends(&self) -> &[String] {
        &self.missing_ends
    }

    /// Leaves out the messages of all channels that do not satisfy the condition. To be called before the first message
    /// is read.
    pub fn retain(&mut self, mut keep: impl FnMut(&RecordedChannel) -> bool) {
        for (is_wanted, channel) in self.is_wanted.iter_mut().zip(&self.channels) {
            *is_wanted = *is_wanted && keep(channel);
        }
    }

    /// Ends the playback as soon as `stop` is true, also while messages are skipped that are not wanted: then
    /// [`next_message`](Self::next_message) returns `None`.
    pub fn stop_at(&mut self, stop: Arc<AtomicBool>) {
        self.stop = stop;
    }

    /// Returns the time from the first message of the recording, of any channel, to this one. Zero before a message was
    /// read.
    #[must_use]
    pub fn offset_ns(&self, at_ns: u64) -> u64 {
        self.start_ns.map_or(0, |start| at_ns.saturating_sub(start))
    }

    /// Reads the next message; `None` at the end, or when it was [stopped](Self::stop_at).
    ///
    /// # Errors
    /// A file cannot be read any more.
    pub fn next_message(&mut self) -> Result<Option<Recorded>, BagError> {
        if self.order == Order::Arrived {
            return self.read_next();
        }
        loop {
            if self.stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let is_full = self.held.len() >= HELD_MAX || self.held_bytes >= HELD_BYTES_MAX;
            let is_due = |sent_ns: u64| {
                is_full || self.read_to_ns.is_none_or(|read_to| read_to >= sent_ns.saturating_add(WINDOW_NS))
            };
            match self.held.first_key_value().map(|((sent_ns, _), _)| *sent_ns) {
                Some(sent_ns) if is_due(sent_ns) => {
                    let first = self.held.pop_first().map(|(_, message)| message);
                    self.held_bytes -= first.as_ref().map_or(0, |message| message.payload.len());
                    return Ok(first);
                }
                None if self.read_to_ns.is_none() => return Ok(None),
                Some(_) | None => self.hold_next()?,
            }
        }
    }

    fn hold_next(&mut self) -> Result<(), BagError> {
        let message = self.read_next()?;
        self.read_to_ns = message.as_ref().map(|message| message.arrived_ns);
        if let Some(message) = message {
            self.read += 1;
            self.held_bytes += message.payload.len();
            self.held.insert((message.sent_ns, self.read), message);
        }
        Ok(())
    }

    /// Reads the next message in the order of arrival.
    fn read_next(&mut self) -> Result<Option<Recorded>, BagError> {
        if !std::mem::replace(&mut self.is_begun, true) {
            for at in 0..self.files.len() {
                self.advance(at)?;
            }
        }
        if self.stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let heads = self.files.iter().enumerate();
        let heads = heads.filter_map(|(at, file)| Some((file.next.as_ref()?.arrived_ns, at)));
        let Some((_, at)) = heads.min() else { return Ok(None) };
        let message = self.files[at].next.take();
        self.advance(at)?;
        Ok(message)
    }

    /// Reads the next wanted message of a file.
    fn advance(&mut self, at: usize) -> Result<(), BagError> {
        let Some(file) = self.files.get_mut(at) else { return Ok(()) };
        loop {
            // The next wanted message may be gigabytes away.
            // SYNC: Relaxed, no other data depends on the flag.
            if self.stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            let message = match file.ahead.take() {
                Some(message) => message,
                None => match file.ordered.next_message()? {
                    Some(message) => message,
                    None => return Ok(()),
                },
            };
            let Some(index) = file.ids.get(&message.channel.id).copied() else { continue };
            let start = self.start_ns.get_or_insert(message.log_ns);
            *start = message.log_ns.min(*start);
            if !self.is_wanted[index] {
                continue;
            }
            let beside = file.ordered.next_message()?;
            let header = beside.as_ref().and_then(|beside| header_of(&message, beside));
            if header.is_none() {
                file.ahead = beside;
            }
            let without = || Header { sequence: message.sequence.into(), ..Header::default() };
            file.next = Some(Recorded {
                channel: Arc::clone(&self.channels[index]),
                index,
                header: header.unwrap_or_else(without),
                sent_ns: message.publish_ns,
                arrived_ns: message.log_ns,
                payload: message.data,
            });
            return Ok(());
        }
    }
}

/// Returns the header of a message, if `beside` is the message beside it. spec: BAG-3
fn header_of(message: &OwnedMessage, beside: &OwnedMessage) -> Option<Header> {
    let Role::Beside(raw) = beside.channel.role() else { return None };
    // In a merged file the topic has the name of its node in front.
    let is_its_own = message.channel.topic.ends_with(raw)
        && (message.log_ns, message.sequence) == (beside.log_ns, beside.sequence);
    let OwnedMessage { channel, sequence, log_ns, publish_ns, data } = beside;
    let (sequence, log_ns, publish_ns) = (*sequence, *log_ns, *publish_ns);
    let beside = Message { channel: Arc::clone(channel), sequence, log_ns, publish_ns, data };
    is_its_own.then(|| Header::of(&beside)).flatten()
}
