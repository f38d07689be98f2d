//! A recording in memory, for checks of applications in virtual time.

use std::{collections::BTreeMap, path::Path, time::Duration};

use serde_bytes::ByteBuf;
use sinew_bag::BagError;
use sinew_replay::{
    CheckError, Checked,
    exchange::{CheckOrder, RecordedMessage},
};
use sinew_runtime::{app::DynApp, tid::Tid, wire::Kind};

use crate::{Order, Playback, Recorded, RecordedChannel};

/// Maximum bytes of a recording's payloads in memory. Each message has some 100 bytes more.
const BYTES_MAX: u64 = 1 << 30;
/// Bytes of a message beside its payload, about.
const MESSAGE_BYTES: u64 = 100;

/// Why a check cannot begin, or its finding.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// A file cannot be read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The recording is too large for the memory of a check.
    #[error(
        "the recording has more than {BYTES_MAX} bytes of messages; check less of it: an earlier end, or fewer applications"
    )]
    TooLong,
    /// No message of the recording is from or to an application of this name.
    #[error("the recording has no application called {name}; it has: {known}")]
    Unknown {
        /// The name.
        name: String,
        /// The names in the recording.
        known: String,
    },
    /// The recording has no message that an application under test sent, or none of the type of its turns.
    #[error(
        "the recording has no message to compare: none that an application under test sent, or none of the type of its turns; record them, too"
    )]
    NothingSent,
    /// All messages that could be read are the same, and others are damaged or missing.
    #[error(
        "all {messages} messages that can be compared are the same, and the recording is not whole: {damage}; give a whole recording, or, if only its end is missing, read it with an earlier end"
    )]
    NotWhole {
        /// The messages that were compared.
        messages: usize,
        /// The damage: the first line of [`Recording::damage`], and the number of the others.
        damage: String,
    },
    /// The applications did not reach the end, or sent other messages.
    #[error(transparent)]
    Check(#[from] CheckError),
}

/// Maximum number of names in an error.
const NAMES_SHOWN: usize = 20;

/// A recording in memory.
///
/// A check runs the applications from the first message on. So the recording must have the start of the program, unless
/// the applications have no state that is older.
///
/// # Examples
///
/// ```no_run
/// use std::time::Duration;
///
/// use sinew::prelude::*;
/// use sinew_player::Recording;
///
/// struct Knee;
/// # impl Actor for Knee { type Context = AppContext<Self>; }
///
/// let recording = Recording::read(&["walk.mcap"])?
///     .ignoring("t_ns") // a field with the time of a turn
///     .starts_before(Duration::from_millis(1)); // its timer of 1 ms gave the first message
/// let checked = recording.check([AppSpec::new("knee", || Knee).into()])?;
/// assert!(checked.messages > 1_000);
/// # Ok::<(), sinew_player::RecordingError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Recording {
    order: CheckOrder,
    damage: Vec<String>,
}

impl Recording {
    /// Reads one file, a merged one, or all parts of one node.
    ///
    /// # Errors
    /// A file cannot be read, the files are of several nodes, or all messages together are too long.
    pub fn read<P: AsRef<Path>>(files: &[P]) -> Result<Self, RecordingError> {
        Self::read_until(files, None)
    }

    /// Same as [`read`](Self::read), without the messages that arrived later than so long after the first one.
    ///
    /// # Errors
    /// As of [`read`](Self::read).
    pub fn read_until<P: AsRef<Path>>(files: &[P], until: Option<Duration>) -> Result<Self, RecordingError> {
        let mut playback = Playback::open(files, Order::Arrived)?;
        playback.retain(|channel| channel.kind.is_user());
        let channels = playback.channels();
        let mut order = CheckOrder { names: names(&playback), ..CheckOrder::default() };
        let types: BTreeMap<_, _> =
            channels.iter().filter_map(|channel| Some((channel.kind, channel.schema.clone()?))).collect();
        order.types = types.into_iter().collect();
        let wall_offset_ns = playback.wall_offset_ns();
        let (mut bytes, mut is_read_to_its_end) = (0, true);
        while let Some(message) = playback.next_message()? {
            let offset = Duration::from_nanos(playback.offset_ns(message.arrived_ns));
            if until.is_some_and(|until| offset > until) {
                is_read_to_its_end = false;
                break;
            }
            bytes += message.payload.len() as u64 + MESSAGE_BYTES;
            if bytes > BYTES_MAX {
                return Err(RecordingError::TooLong);
            }
            order.messages.push(recorded(message, wall_offset_ns));
        }
        let mut damage = playback.damage().to_vec();
        if is_read_to_its_end {
            damage.extend_from_slice(playback.missing_ends());
        }
        Ok(Self { order, damage })
    }

    /// Returns a line for each damaged record of the files, and for each missing end that was to be read. A check
    /// proves nothing about these messages.
    #[must_use]
    pub fn damage(&self) -> &[String] {
        &self.damage
    }

    /// Ignores a field of all payloads, for example one with a time. A field of a field is `pose.t_ns`, an element of a
    /// list `samples[2]`.
    #[must_use]
    pub fn ignoring(mut self, field: impl Into<String>) -> Self {
        self.order.ignored.push(field.into());
        self
    }

    /// Starts the applications so long before the first message from or to one of them. Default zero. An application
    /// with a timer of 10 ms that gave the first message started 10 ms before it.
    #[must_use]
    pub fn starts_before(mut self, time: Duration) -> Self {
        self.order.starts_before_ns = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        self
    }

    /// Sets the type by which the applications record their turns, by its name: see
    /// [`Replay::turns`](sinew_replay::Replay::turns). Only messages of this type are compared.
    #[must_use]
    pub fn turns(mut self, type_name: &str) -> Self {
        self.order.turns = Some(Kind::named(type_name));
        self
    }

    /// Returns the address that an application or a destination of this name had.
    #[must_use]
    pub fn address(&self, name: &str) -> Option<Tid> {
        self.order.names.get(name).copied().map(Tid::from_bits)
    }

    /// Runs these applications in virtual time on the messages that arrived at them, and compares all that they send
    /// with the recording.
    ///
    /// # Errors
    /// The recording has no message of an application of this name, the applications did not reach the end, or they
    /// sent another message: the first one is named with the field and both values. Without such a difference, the
    /// recording is damaged or has no end.
    pub fn check(&self, apps: impl IntoIterator<Item = DynApp>) -> Result<Checked, RecordingError> {
        let apps: Vec<_> = apps.into_iter().collect();
        for app in &apps {
            self.check_name(app.name())?;
        }
        let mut order = self.order.clone();
        order.apps = apps.iter().map(|app| app.name().to_owned()).collect();
        let checked = order.check(apps)?;
        if checked.messages == 0 {
            return Err(RecordingError::NothingSent);
        }
        let Some(first) = self.damage.first() else { return Ok(checked) };
        let further = match self.damage.len() - 1 {
            0 => String::new(),
            further => format!(", and {further} further faults"),
        };
        Err(RecordingError::NotWhole { messages: checked.messages, damage: format!("{first}{further}") })
    }

    /// Returns the order for a program that `sinew play --check` starts. Without names all of its applications that the
    /// recording has are under test.
    ///
    /// # Errors
    /// The recording has no application of one of these names.
    #[doc(hidden)]
    pub fn into_order(mut self, apps: &[String]) -> Result<CheckOrder, RecordingError> {
        for name in apps {
            self.check_name(name)?;
        }
        self.order.apps = apps.to_vec();
        Ok(self.order)
    }

    fn check_name(&self, name: &str) -> Result<(), RecordingError> {
        if self.order.names.contains_key(name) {
            return Ok(());
        }
        let names: Vec<_> = self.order.names.keys().take(NAMES_SHOWN).map(String::as_str).collect();
        let known = if names.is_empty() { "none with a name".to_owned() } else { names.join(", ") };
        Err(RecordingError::Unknown { name: name.to_owned(), known })
    }
}

/// Returns the addresses of all names of applications. If several applications have one name, that of the recording's
/// own node counts, else the first one.
fn names(playback: &Playback) -> BTreeMap<String, u64> {
    let mut names: BTreeMap<String, Tid> = BTreeMap::new();
    let is_here = |tid: Tid| tid.node.to_string() == playback.node();
    for (name, tid) in playback.channels().iter().flat_map(|channel| ends(channel)) {
        let Some(name) = name.filter(|_| tid.is_single()) else { continue };
        let known = names.entry(name).or_insert(tid);
        if is_here(tid) && !is_here(*known) {
            *known = tid;
        }
    }
    names.into_iter().map(|(name, tid)| (name, tid.bits())).collect()
}

/// Returns names and addresses of the source and the destination.
fn ends(channel: &RecordedChannel) -> [(Option<String>, Tid); 2] {
    let RecordedChannel { source, source_name, destination, destination_name, .. } = channel;
    [(source_name.clone(), *source), (destination_name.clone(), *destination)]
}

/// Returns a message with times of the node's monotonic clock.
fn recorded(message: Recorded, wall_offset_ns: i64) -> RecordedMessage {
    let Recorded { channel, header, sent_ns, arrived_ns, payload, .. } = message;
    let monotonic = |wall_ns: u64| wall_ns.saturating_sub_signed(wall_offset_ns);
    RecordedMessage {
        source: channel.source.bits(),
        destination: channel.destination.bits(),
        kind: channel.kind,
        class: channel.class,
        flags: header.flags,
        sequence: header.sequence,
        correlation: header.correlation,
        sent_ns: monotonic(sent_ns),
        sent_error_ns: header.error_ns,
        arrived_ns: monotonic(arrived_ns),
        time_to_live_us: header.time_to_live_us,
        is_refused: channel.is_refused,
        payload: ByteBuf::from(payload),
    }
}
