//! Reads the messages of a node as they pass, for programs that show them. It writes no file.

use std::{collections::BTreeMap, path::Path, time::Duration};

use sinew_record::{AskRecord, Channel, Entry, Form, MessageEntry, RecordReport, Selection};
use sinew_runtime::{tid::Tid, time::Time, wire::Header};
use sinew_shm::journal::{JournalReader, ReadJournalError, Start};

use crate::{
    RecordingError,
    names::Names,
    session::{Connection, RENEWAL, RENEWED_WITHIN, ask, leave},
};

/// Time that a record may stay unfinished: its writer may have been preempted.
const PATIENCE: Duration = Duration::from_millis(20);
/// Maximum records of one call.
const RECORDS_MAX: usize = 16_384;

/// Reads the messages of a node as they pass. The node records them into its journal for as long as this asks for them;
/// no sender waits.
///
/// Records that the journal has replaced before they were read are missed, and not counted.
///
/// # Examples
///
/// ```no_run
/// use sinew_client::Endpoint;
/// use sinew_recorder::{Follower, RecordingError, Selection};
///
/// /// Prints the messages of an application for as long as the node lives.
/// fn follow(endpoint: Endpoint, app: &str) -> Result<(), RecordingError> {
///     let selection = Selection { apps: vec![app.to_owned()], ..Selection::default() };
///     let mut follower = Follower::begin(endpoint, selection)?;
///     loop {
///         follower.poll(&mut |seen| println!("{} bytes from {}", seen.length, seen.header.source))?;
///         std::thread::sleep(std::time::Duration::from_millis(10));
///     }
/// }
/// ```
#[derive(Debug)]
pub struct Follower<C: Connection> {
    connection: C,
    question: AskRecord,
    reader: JournalReader,
    names: Names,
    channels: BTreeMap<u16, Channel>,
    buffer: Vec<u8>,
    /// When the next question is due.
    renewal: Time,
}

/// A message that has passed.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'m> {
    /// When the node saw it, on the clock of its host.
    pub at: Time,
    /// Its header.
    pub header: Header,
    /// Its destination; of received messages to a group, the member.
    pub destination: Tid,
    /// Bytes of its payload.
    pub length: usize,
    /// Its payload; empty if the node had only its length.
    pub payload: &'m [u8],
    /// Whether this is the copy of its sender. If its destination is on another node, that node has a copy, too.
    pub is_sent: bool,
    /// Whether it was rejected.
    pub is_rejected: bool,
    /// The names that are known.
    pub names: &'m Names,
}

impl<C: Connection> Follower<C> {
    /// Begins at the node of this connection, with the next message.
    ///
    /// # Errors
    /// The selection is illegal, the node does not record for this program, or its journal cannot be read.
    pub fn begin(mut connection: C, selection: Selection) -> Result<Self, RecordingError> {
        selection.check()?;
        let question = AskRecord { selection, ..AskRecord::default() };
        let within = connection.patience();
        let first = ask(&mut connection, &question, within)?;
        let reader = match open(&first) {
            Ok(reader) => reader,
            Err(why) => {
                leave(&mut connection, None);
                return Err(why);
            }
        };
        let mut names = Names::default();
        names.learn(&first, &[]);
        let (channels, buffer, renewal) = (BTreeMap::new(), Vec::new(), Time::now() + RENEWAL);
        Ok(Self { connection, question, reader, names, channels, buffer, renewal })
    }

    /// Selects other messages, at once.
    ///
    /// # Errors
    /// The selection is illegal, or the node does not answer: then the next [`poll`](Self::poll) asks it again.
    pub fn select(&mut self, selection: Selection) -> Result<(), RecordingError> {
        selection.check()?;
        if self.question.selection != selection {
            self.question.selection = selection;
            self.renewal = Time::now();
            self.renew()?;
        }
        Ok(())
    }

    /// Hands over the messages since the last call, at most 16,384, and renews the recording at the node each second.
    /// It never waits for a message; for the node it waits at most 300 ms. The journal may have more than the selected
    /// ones: those that other programs record.
    ///
    /// # Errors
    /// The node does not answer or has ended, or the journal cannot be read. After a damaged record the next call
    /// continues.
    pub fn poll(&mut self, take: &mut dyn FnMut(&Seen<'_>)) -> Result<(), RecordingError> {
        let now = Time::now();
        if now >= self.renewal {
            self.renew()?;
        }
        let own = self.connection.own();
        for _ in 0..RECORDS_MAX {
            let Some(record) = self.reader.next(now.as_nanos(), &mut self.buffer)? else { break };
            // A record of a newer version, or a fact, is no message.
            let Ok(Entry::Message(message)) = Entry::read(&self.buffer) else { continue };
            let MessageEntry { form, header, length, payload, refused } = message;
            if own.contains(&header.source) || own.contains(&header.destination) {
                continue;
            }
            let channel = self.channels.get(&record.place).map(|channel| channel.destination);
            let destination = match channel {
                Some(destination) => destination,
                None => channel_of(&self.reader, &mut self.channels, record.place)?
                    .map_or(header.destination, |channel| channel.destination),
            };
            let at = Time::from_nanos(record.time);
            let (is_sent, is_rejected) = (form == Form::Sent, refused.is_some());
            let (payload, names) = (payload.unwrap_or_default(), &self.names);
            take(&Seen { at, header, destination, length, payload, is_sent, is_rejected, names });
        }
        Ok(())
    }

    /// Ends the recording at the node, and returns the connection.
    pub fn finish(mut self) -> C {
        leave(&mut self.connection, None);
        self.connection
    }

    fn renew(&mut self) -> Result<(), RecordingError> {
        let report = ask(&mut self.connection, &self.question, RENEWED_WITHIN)?;
        self.renewal = Time::now() + RENEWAL;
        self.names.learn(&report, &[]);
        // The lease had ended, for example because this program was stopped: the node has begun another journal.
        if self.reader.is_closed()? {
            self.reader = open(&report)?;
            self.channels.clear();
        }
        Ok(())
    }
}

fn open(report: &RecordReport) -> Result<JournalReader, RecordingError> {
    let Some(path) = &report.path else {
        return Err(RecordingError::NoAnswer("it names no journal; update it".to_owned()));
    };
    let mut reader = JournalReader::open(Path::new(path), Start::Newest)?;
    reader.set_patience(PATIENCE);
    Ok(reader)
}

/// Reads the table of channels, and returns the channel at this place.
fn channel_of(
    reader: &JournalReader,
    channels: &mut BTreeMap<u16, Channel>,
    place: u16,
) -> Result<Option<Channel>, ReadJournalError> {
    for one in reader.channels()? {
        if let Some(channel) = one.key.and_then(Channel::of) {
            channels.insert(one.place, channel);
        }
    }
    Ok(channels.get(&place).copied())
}
