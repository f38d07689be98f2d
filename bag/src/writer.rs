//! The writer of recordings.

mod channel;
mod part;
mod records;
#[cfg(test)]
mod tests;
mod views;

use std::{collections::BTreeSet, io::ErrorKind, path::PathBuf};

use crate::{
    error::BagError,
    protobuf::Output,
    terms::{ChannelId, ChannelInfo, ClockReading, Event, Options, Origin, Record, Totals},
    view,
};
use channel::{Channel, Companion, View};
use part::Part;

pub(crate) use part::{METADATA, cause};
pub(crate) use records::{CLOCK_TOPIC, TALLY_TOPIC};
pub use views::{ViewChannel, ViewItem, ViewWriter};

/// Maximum channels of a recording. Each has two in the file, and MCAP has room for 65,535.
const CHANNELS_MAX: usize = 16_384;
/// A chunk that is this old is written, so that a killed recorder loses no more.
const CHUNK_AGE_NS: u64 = 1_000_000_000;
/// How long after a failure the next file is tried.
const RETRY_NS: u64 = 1_000_000_000;

/// Maximum names of existing files that are skipped when a part begins.
const NAMES_SKIPPED_MAX: u32 = 1_000;
/// After a failure a new part needs room for so many chunks.
const CHUNKS_FREE: u64 = 8;

/// Whether messages are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Writing,
    /// A write failed. The next file is tried at this time.
    Failed {
        retry_ns: u64,
    },
    /// The recording has its maximum size.
    Full,
}

/// Writes a recording, in one file or in several parts.
///
/// Every message is either written or counted as dropped. After a failed write the file is complete up to its last
/// chunk, what follows is counted as dropped, and a new part is tried once a second. An error is returned once for each
/// failure.
///
/// A file without [`finish`](Self::finish) is unfinished: it can be read up to its last chunk, which is at most a
/// second old.
///
/// # Examples
///
/// ```
/// use sinew_bag::{BagWriter, ChannelInfo, Class, Direction, Options, Origin, Party, Record};
///
/// let path = std::env::temp_dir().join(format!("sinew-bag-example-{}.mcap", std::process::id()));
/// let origin = Origin { node: "knee".into(), address: "127.0.0.2".into(), ..Origin::default() };
/// let mut bag = BagWriter::create(path.clone(), Options::default(), origin)?;
/// let source = Party { tid: 1, text: "127.0.0.2/1".into(), name: Some("knee.sensor".into()), node: None };
/// let destination = Party { tid: 2, text: "127.0.0.3/1".into(), ..source.clone() };
/// let channel = bag.channel(&ChannelInfo {
///     source: &source,
///     destination: &destination,
///     type_name: "exo.angle",
///     kind: 7,
///     class: Class::Stream,
///     direction: Direction::Sent,
///     is_protected: false,
///     schema: None,
///     refused: None,
///     seen_before: 0,
/// })?;
/// // The payload is {"degrees": 5}.
/// bag.message(channel, &Record { number: 1, sequence: 1, payload: b"\x81\xa7degrees\x05", ..Record::default() })?;
/// bag.tally(1_000_000_000)?;
/// let totals = bag.finish(2_000_000_000)?;
/// assert_eq!((totals.seen, totals.written, totals.dropped), (1, 1, 0));
/// # std::fs::remove_file(path).expect("it is there");
/// # Ok::<(), sinew_bag::BagError>(())
/// ```
#[derive(Debug)]
pub struct BagWriter {
    path: PathBuf,
    /// The file of the last part that was begun.
    current: PathBuf,
    options: Options,
    origin: Origin,
    channels: Vec<Channel>,
    /// The topics in use, as each channel needs its own.
    topics: BTreeSet<String>,
    part: Option<Part>,
    state: State,
    /// The number of the next part.
    parts: u32,
    /// The number in the name of the next part. It is higher than that of the part where a file existed.
    next_name: u32,
    /// Bytes of the parts before.
    bytes_before: u64,
    /// When the current chunk began, or the last one ended.
    chunk_since_ns: u64,
    events_lost: u64,
    /// Events and clock readings in the current chunk.
    events_unsaved: u64,
    companion: Output,
}

impl BagWriter {
    /// Creates the file of a recording. Further parts have a number before the ending: `walk.mcap`, `walk.1.mcap`. They
    /// skip the numbers of existing files, unless [`Options::replace`] is set.
    ///
    /// # Errors
    /// The file cannot be made, or exists and [`Options::replace`] is not set.
    pub fn create(path: impl Into<PathBuf>, mut options: Options, origin: Origin) -> Result<Self, BagError> {
        // Some chunks fit also into a small recording.
        let chunk_max = options.size_max.map_or(u64::MAX, |all| all / 8);
        options.chunk_bytes = options.chunk_bytes.min(chunk_max).max(1_024);
        let path: PathBuf = path.into();
        let began_ns = origin.began_ns;
        let mut writer = Self {
            current: path.clone(),
            path,
            options,
            origin,
            channels: Vec::new(),
            topics: BTreeSet::new(),
            part: None,
            state: State::Writing,
            parts: 0,
            next_name: 0,
            bytes_before: 0,
            chunk_since_ns: began_ns,
            events_lost: 0,
            events_unsaved: 0,
            companion: Output::default(),
        };
        writer.open_part(began_ns)?;
        Ok(writer)
    }

    /// Returns the file of the current part; after a failure, of the one before.
    #[must_use]
    pub fn path(&self) -> PathBuf {
        self.current.clone()
    }

    /// Returns whether messages are written. Otherwise they are counted as dropped.
    #[must_use]
    pub fn is_writing(&self) -> bool {
        self.state == State::Writing
    }

    /// Adds a channel. It stands in the file from its first message on.
    ///
    /// # Errors
    /// The recording has as many channels as it may have.
    pub fn channel(&mut self, info: &ChannelInfo<'_>) -> Result<ChannelId, BagError> {
        if self.channels.len() >= CHANNELS_MAX {
            return Err(BagError::Channels { path: self.path(), limit: CHANNELS_MAX });
        }
        let channel = Channel::new(info, self.options.raw_only, &mut self.topics);
        self.channels.push(channel);
        Ok(ChannelId(self.channels.len() as u32 - 1))
    }

    fn of(&mut self, channel: ChannelId) -> &mut Channel {
        // Only `channel` makes these numbers, and no channel is removed.
        &mut self.channels[channel.0 as usize]
    }

    /// Writes a message, or counts it as dropped while nothing can be written.
    ///
    /// # Errors
    /// The first failure of writing since the last success. The message is counted either way.
    ///
    /// # Panics
    /// If `channel` is of another recording.
    pub fn message(&mut self, channel: ChannelId, record: &Record<'_>) -> Result<(), BagError> {
        let now_ns = record.handed_over_ns;
        self.resume(now_ns);
        let channel = &mut self.channels[channel.0 as usize];
        channel.sees(record.number);
        let Some(part) = &mut self.part else {
            channel.counts.dropped += 1;
            return Ok(());
        };
        self.companion.0.clear();
        channel.counts.misfits += u64::from(!channel.companion(record, &mut self.companion));
        let header = mcap::records::MessageHeader {
            channel_id: 0,
            sequence: record.sequence as u32,
            log_time: self.origin.wall_ns(record.handed_over_ns),
            publish_time: self.origin.wall_ns(record.sent_ns),
        };
        let written = part.message(channel, header, [record.payload, &self.companion.0]);
        channel.counts.written += 1;
        channel.unsaved += 1;
        if let Err(error) = written {
            return Err(self.fail(error, now_ns));
        }
        self.settle(now_ns)
    }

    /// Counts messages that the recorder did not get. `span_ns` is the time in which they were, as far as it is known.
    ///
    /// # Errors
    /// As [`message`](Self::message).
    ///
    /// # Panics
    /// If `channel` is of another recording.
    pub fn dropped(&mut self, channel: ChannelId, count: u64, span_ns: (u64, u64)) -> Result<(), BagError> {
        let (seen, topic) = {
            let channel = self.of(channel);
            channel.counts.dropped += count;
            channel.counts.seen += count;
            (channel.counts.seen, channel.topic.clone())
        };
        let text = format!("{topic}: {count} messages were not recorded: the recorder was too slow");
        let data = serde_json::json!({
            "topic": topic, "count": count, "seen": seen,
            "from_ns": self.origin.wall_ns(span_ns.0), "to_ns": self.origin.wall_ns(span_ns.1),
        });
        self.event(&records::gap(&text, &data, span_ns.1))
    }

    /// States the number of the channel's last message, as the node counts it.
    ///
    /// # Panics
    /// If `channel` is of another recording.
    pub fn seen(&mut self, channel: ChannelId, number: u64) {
        self.of(channel).sees(number);
    }

    /// Writes the counters of all channels that changed, and the current chunk. The recorder calls it each second.
    ///
    /// # Errors
    /// As [`message`](Self::message).
    pub fn tally(&mut self, now_ns: u64) -> Result<(), BagError> {
        self.resume(now_ns);
        if let Some(part) = &mut self.part {
            let text = records::tally(&mut self.channels, part.number, self.events_lost, false);
            let log_time = self.origin.wall_ns(now_ns);
            if let Err(error) = part.record(&records::TALLY, log_time, text.as_bytes()) {
                return Err(self.fail(error, now_ns));
            }
            return self.save(now_ns);
        }
        Ok(())
    }

    /// Writes the measured clock of another node. The recorder calls it each second for each.
    ///
    /// # Errors
    /// As [`message`](Self::message).
    pub fn clock(&mut self, now_ns: u64, reading: &ClockReading) -> Result<(), BagError> {
        let text = records::clock(&self.origin, now_ns, reading);
        self.record(&records::CLOCK, now_ns, &text)
    }

    /// Writes an event.
    ///
    /// # Errors
    /// As [`message`](Self::message).
    pub fn event(&mut self, event: &Event<'_>) -> Result<(), BagError> {
        let text = records::event(&self.origin, event);
        self.record(records::of_topic(event.topic), event.at_ns, &text)
    }

    /// Counts events, clock readings or outcomes that the recorder did not get.
    pub const fn lose_events(&mut self, count: u64) {
        self.events_lost = self.events_lost.saturating_add(count);
    }

    fn record(&mut self, of: &records::Fixed, now_ns: u64, text: &str) -> Result<(), BagError> {
        self.resume(now_ns);
        let Some(part) = &mut self.part else {
            self.events_lost += 1;
            return Ok(());
        };
        self.events_unsaved += 1;
        let log_time = self.origin.wall_ns(now_ns);
        if let Err(error) = part.record(of, log_time, text.as_bytes()) {
            return Err(self.fail(error, now_ns));
        }
        self.settle(now_ns)
    }

    /// Writes the last tally and the summary.
    ///
    /// # Errors
    /// The end of the file cannot be written. It can be read up to its last chunk.
    pub fn finish(mut self, now_ns: u64) -> Result<Totals, BagError> {
        self.end_part(now_ns)?;
        Ok(self.totals())
    }

    /// Returns the counters of all channels together.
    #[must_use]
    pub fn totals(&self) -> Totals {
        let own = self.part.as_ref().map_or(0, |part| part.saved);
        let parts = self.parts;
        let start = Totals {
            events_lost: self.events_lost,
            bytes: self.bytes_before + own,
            parts,
            ..Totals::default()
        };
        self.channels.iter().fold(start, |sum, Channel { counts, .. }| Totals {
            seen: sum.seen + counts.seen,
            written: sum.written + counts.written,
            dropped: sum.dropped + counts.dropped,
            misfits: sum.misfits + counts.misfits,
            ..sum
        })
    }

    /// Writes the current chunk if it is large or old enough, and ends the part where its limits say so.
    fn settle(&mut self, now_ns: u64) -> Result<(), BagError> {
        let is_large = self.part.as_ref().is_some_and(|part| part.chunk_bytes >= self.options.chunk_bytes);
        if is_large || now_ns.saturating_sub(self.chunk_since_ns) >= CHUNK_AGE_NS {
            return self.save(now_ns);
        }
        Ok(())
    }

    fn save(&mut self, now_ns: u64) -> Result<(), BagError> {
        self.chunk_since_ns = self.chunk_since_ns.max(now_ns);
        let Some(part) = &mut self.part else { return Ok(()) };
        if let Err(error) = part.save() {
            return Err(self.fail(error, now_ns));
        }
        self.saved();
        let Some(part) = &self.part else { return Ok(()) };
        // The next chunk and the summary have to fit, too.
        let bytes = self.bytes_before + part.saved;
        let needed = bytes + part.summary_bytes(self.channels.len()) + 2 * self.options.chunk_bytes;
        if self.options.size_max.is_some_and(|all| needed > all) {
            self.end_part(now_ns)?;
            self.state = State::Full;
            return Err(BagError::Full { path: self.path(), bytes: self.bytes_before });
        }
        let is_long = self.options.split_bytes.is_some_and(|limit| part.saved >= limit);
        let age_ns = u128::from(now_ns.saturating_sub(part.began_ns));
        let is_old = self.options.split_time.is_some_and(|limit| age_ns >= limit.as_nanos());
        if !is_long && !is_old {
            return Ok(());
        }
        self.end_part(now_ns)?;
        self.open_part(now_ns).map_err(|error| self.failed(error, now_ns))
    }

    /// Notes that all messages so far are in the file.
    fn saved(&mut self) {
        self.channels.iter_mut().for_each(|channel| channel.unsaved = 0);
        self.events_unsaved = 0;
    }

    fn end_part(&mut self, now_ns: u64) -> Result<(), BagError> {
        let Some(part) = &mut self.part else { return Ok(()) };
        let text = records::tally(&mut self.channels, part.number, self.events_lost, true);
        let log_time = self.origin.wall_ns(now_ns);
        let ended = part.record(&records::TALLY, log_time, text.as_bytes()).and_then(|()| part.finish());
        if let Err(error) = ended {
            return Err(self.fail(error, now_ns));
        }
        self.bytes_before += part.saved;
        self.part = None;
        self.saved();
        Ok(())
    }

    /// Creates the file of the next part. Only the first part fails where its file exists.
    fn create_part(&mut self, now_ns: u64) -> Result<Part, BagError> {
        let last = self.next_name.saturating_add(NAMES_SKIPPED_MAX);
        loop {
            let path = part::path(&self.path, self.next_name);
            let created = Part::create(path, self.parts, &self.options, &self.origin, now_ns);
            let exists = matches!(
                &created,
                Err(BagError::Write { cause, .. }) if cause.kind() == ErrorKind::AlreadyExists
            );
            if !exists || self.parts == 0 || self.next_name >= last {
                return created;
            }
            self.next_name += 1;
        }
    }

    /// Begins the next part with the counters as they are.
    fn open_part(&mut self, now_ns: u64) -> Result<(), BagError> {
        let number = self.parts;
        let mut part = self.create_part(now_ns)?;
        let text = records::tally(&mut self.channels, number, self.events_lost, true);
        let log_time = self.origin.wall_ns(now_ns);
        let begun = part.record(&records::TALLY, log_time, text.as_bytes()).and_then(|()| part.save());
        if let Err(error) = begun {
            let error = BagError::write(&part.path, error);
            part.discard();
            return Err(error);
        }
        self.current.clone_from(&part.path);
        (self.part, self.state) = (Some(part), State::Writing);
        self.parts += 1;
        self.next_name = self.next_name.saturating_add(1);
        self.chunk_since_ns = now_ns;
        Ok(())
    }

    /// Tries a new part after a failure, once a second. It stays silent if that fails, too.
    fn resume(&mut self, now_ns: u64) {
        let State::Failed { retry_ns } = self.state else { return };
        if now_ns < retry_ns {
            return;
        }
        // Otherwise a full disk would get a new file with a few messages each second.
        let needed = self.options.chunk_bytes.saturating_mul(CHUNKS_FREE);
        let has_room = part::free_bytes(&self.path).is_none_or(|free| free >= needed);
        if !has_room || self.open_part(now_ns).is_err() {
            self.state = State::Failed { retry_ns: now_ns.saturating_add(RETRY_NS) };
        }
    }

    /// Gives up the current part: it ends with its last chunk.
    fn fail(&mut self, cause: std::io::Error, now_ns: u64) -> BagError {
        let path = self.path();
        if let Some(part) = self.part.take() {
            self.bytes_before += part.saved;
        }
        for channel in &mut self.channels {
            channel.counts.written -= channel.unsaved;
            channel.counts.dropped += channel.unsaved;
            channel.unsaved = 0;
        }
        self.events_lost += self.events_unsaved;
        self.events_unsaved = 0;
        self.failed(BagError::write(&path, cause), now_ns)
    }

    fn failed(&mut self, error: BagError, now_ns: u64) -> BagError {
        self.state = State::Failed { retry_ns: now_ns.saturating_add(RETRY_NS) };
        error
    }
}

impl Channel {
    /// Writes the companion of a message. Returns whether the payload fits its schema.
    fn companion(&self, record: &Record<'_>, out: &mut Output) -> bool {
        match &self.companion.view {
            View::Header => {
                view::header(record, None, out);
                true
            }
            View::Typed(plan) => {
                let misfit = plan.encode(record.value(), out).err();
                if misfit.is_some() {
                    out.0.clear();
                }
                out.message(view::HEADER_FIELD, |header| view::header(record, misfit, header));
                misfit.is_none()
            }
            View::Json => {
                out.0.extend_from_slice(records::json_view(record).as_bytes());
                true
            }
        }
    }
}

impl Companion {
    fn encoding(&self) -> &'static str {
        match self.view {
            View::Json => "json",
            View::Typed(_) | View::Header => "protobuf",
        }
    }
}
