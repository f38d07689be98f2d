//! Reads the messages of a node as they pass, with the topics and the views of a recording. It writes no file.

use std::{collections::BTreeSet, path::Path};

use sinew_bag::{Origin, ViewItem, ViewWriter};
use sinew_record::{AskRecord, RecordReport, SCHEMAS_MAX, Selection};
use sinew_runtime::{time::Time, wire::Kind};
use sinew_shm::journal::{JournalReader, ReadJournalError, Start};

use crate::{
    RecordingError,
    names::Names,
    recorder::Recorder,
    session::{Connection, RENEWAL, RENEWED_WITHIN, ask, leave},
    setup::Setup,
};

/// Maximum calls of the recorder in one poll: some 16,000 records.
const PUMPS_MAX: usize = 4;
/// Maximum questions for names and structures between two renewals. Further channels have addresses in their topics,
/// and views as JSON.
const QUESTIONS_MAX: u32 = 64;

/// Reads the messages of a node as a recording would have them, for programs that show them: in the order of their
/// numbers, with the same topics, metadata and views. The node records them into its journal for as long as this asks
/// for them; no sender waits.
///
/// # Examples
///
/// ```no_run
/// use std::collections::BTreeSet;
///
/// use sinew_client::Endpoint;
/// use sinew_recorder::{LiveViews, RecordingError, Selection, ViewItem};
///
/// /// Prints the length of each view of a topic for as long as the node lives.
/// fn follow(endpoint: Endpoint, topic: &str) -> Result<(), RecordingError> {
///     let mut live = LiveViews::begin(endpoint, Selection::default(), Selection::default())?;
///     live.want(&BTreeSet::from([topic.to_owned()]));
///     loop {
///         live.poll(&mut |item| match item {
///             ViewItem::Message { time_ns, data, .. } => println!("{time_ns}: {} bytes", data.len()),
///             ViewItem::Channel(channel) => println!("{} is a channel", channel.topic),
///             ViewItem::Missed { count, .. } => println!("{count} messages are missing"),
///         })?;
///         std::thread::sleep(std::time::Duration::from_millis(10));
///     }
/// }
/// ```
#[derive(Debug)]
pub struct LiveViews<C: Connection> {
    connection: C,
    question: AskRecord,
    recorder: Recorder,
    /// When the next question is due.
    renewal: Time,
    /// Questions for names and structures since the last renewal.
    questions: u32,
}

impl<C: Connection> LiveViews<C> {
    /// Begins at the node of this connection, with the next message. The node records the messages of `selection`.
    /// Those of `shown` become channels: the journal may have more, for other programs.
    ///
    /// # Errors
    /// A selection is illegal, the node does not record for this program, or its journal cannot be read.
    pub fn begin(mut connection: C, selection: Selection, shown: Selection) -> Result<Self, RecordingError> {
        selection.check()?;
        shown.check()?;
        let question = AskRecord { selection, ..AskRecord::default() };
        let within = connection.patience();
        let first = ask(&mut connection, &question, within)?;
        match open(&connection, shown, &first) {
            Ok(recorder) => {
                let renewal = Time::now() + RENEWAL;
                Ok(Self { connection, question, recorder, renewal, questions: 0 })
            }
            Err(why) => {
                leave(&mut connection, None);
                Err(why)
            }
        }
    }

    /// Has the node record other messages, at once.
    ///
    /// # Errors
    /// The selection is illegal, or the node does not answer: then the next [`poll`](Self::poll) asks it again.
    pub fn select(&mut self, selection: Selection) -> Result<(), RecordingError> {
        selection.check()?;
        if self.question.selection != selection {
            self.question.selection = selection;
            self.renewal = Time::now();
            self.renew(Vec::new())?;
        }
        Ok(())
    }

    /// Sets the topics of which views are made.
    pub fn want(&mut self, topics: &BTreeSet<String>) {
        self.recorder.want(topics);
    }

    /// Hands over new channels, and the views of the messages since the last call, at most some 16,000. It renews the
    /// recording at the node each second. It never waits for a message; for the node it waits at most 300 ms at a time.
    ///
    /// # Errors
    /// The node does not answer, it has ended the recording, or the journal cannot be read. Begin anew then.
    pub fn poll(&mut self, take: &mut dyn FnMut(ViewItem)) -> Result<(), RecordingError> {
        self.recorder.leave_out(self.connection.own());
        for _ in 0..PUMPS_MAX {
            let pumped = self.recorder.pump(Time::now().as_nanos());
            self.recorder.take_views().into_iter().for_each(&mut *take);
            let is_empty = match pumped {
                Ok(is_empty) => is_empty,
                // Its messages are missing by their numbers.
                Err(ReadJournalError::Damaged { .. }) => true,
                Err(why) => return Err(why.into()),
            };
            if self.recorder.is_waiting() && self.questions < QUESTIONS_MAX {
                self.questions += 1;
                let wanted = self.recorder.wanted(SCHEMAS_MAX);
                self.renew(wanted)?;
            }
            if is_empty {
                break;
            }
        }
        // Only now: a node that has ended leaves its last messages.
        if Time::now() >= self.renewal {
            self.questions = 0;
            self.renew(Vec::new())?;
        }
        Ok(())
    }

    /// Ends the recording at the node, and returns the connection.
    pub fn finish(mut self) -> C {
        leave(&mut self.connection, None);
        self.connection
    }

    fn renew(&mut self, schemas: Vec<Kind>) -> Result<(), RecordingError> {
        self.question.schemas = schemas;
        let within = RENEWED_WITHIN.min(self.connection.patience());
        let report = ask(&mut self.connection, &self.question, within)?;
        self.renewal = Time::now() + RENEWAL;
        self.recorder.names_mut().learn(&report, &self.question.schemas);
        // The lease had ended, for example because this program was stopped: the node has begun another journal.
        if self.recorder.is_closed()? {
            return Err(RecordingError::NoAnswer("the node has ended its recording; begin anew".to_owned()));
        }
        Ok(())
    }
}

fn open<C: Connection>(
    connection: &C,
    shown: Selection,
    first: &RecordReport,
) -> Result<Recorder, RecordingError> {
    let Some(path) = &first.path else {
        return Err(RecordingError::NoAnswer("it names no journal; update it".to_owned()));
    };
    let reader = JournalReader::open(Path::new(path), Start::Newest)?;
    let node = first.node.unwrap_or_else(|| connection.node());
    let origin = Origin {
        node: first.name.clone(),
        address: node.to_string(),
        incarnation: first.incarnation.map_or(0, |incarnation| incarnation.0),
        wall_offset_ns: first.wall_offset_ns,
        began_ns: Time::now().as_nanos(),
        ..Origin::default()
    };
    let mut names = Names::default();
    names.learn(first, &[]);
    let setup = Setup { node, selection: shown, names, left_out: connection.own() };
    Ok(Recorder::begin_views(reader, ViewWriter::new(origin), setup)?)
}
