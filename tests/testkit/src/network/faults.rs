//! The possible faults of the network, and the commands for them.

use std::{
    num::{NonZeroU32, NonZeroU64, NonZeroUsize},
    str::FromStr,
    time::Duration,
};

/// One of the two sides of the network. A direction is named by the side that it leads to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The left side.
    Left,
    /// The right side.
    Right,
}

impl Side {
    /// The other side, from which the traffic to this side comes.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Left => Self::Right,
            Self::Right => Self::Left,
        }
    }

    pub(super) const fn index(self) -> usize {
        self as usize
    }
}

/// The faults of one direction. By default there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Blocks all traffic: it waits, and beyond a limit no more is accepted.
    pub stalled: bool,
    /// Cuts the cable: bytes of connections wait, as TCP would retransmit them; datagrams are lost.
    pub parted: bool,
    /// Delay of all traffic.
    pub delay: Duration,
    /// Maximum additional random delay. Bytes of a connection stay in order, datagrams do not.
    pub jitter: Duration,
    /// Maximum number of bytes of a connection per write. Each write usually becomes a segment of its own.
    pub segment_max: Option<NonZeroUsize>,
    /// Flips one bit in about this many bytes.
    pub one_flip_in: Option<NonZeroU32>,
    /// Loses one in about this many datagrams, each independently.
    pub one_loss_in: Option<NonZeroU32>,
    /// Rate limit.
    pub bytes_per_second: Option<NonZeroU64>,
}

impl Faults {
    /// Returns whether all traffic is blocked now.
    pub(super) const fn is_blocked(&self) -> bool {
        self.stalled || self.parted
    }
}

/// The way a connection is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    /// By RST: data in flight is lost.
    Reset,
    /// By FIN, in both directions.
    Finish,
}

/// A command to the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkCommand {
    /// Cut all connections.
    Cut(Cut),
    /// Stop or resume listening.
    Refuse(bool),
    /// Change the faults of this direction, or of both.
    Change(Option<Side>, Change),
    /// End all faults, and listen.
    Heal,
}

/// A change of the faults of a direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// [`Faults::stalled`].
    Stall,
    /// [`Faults::parted`].
    Part,
    /// [`Faults::delay`].
    Delay(Duration),
    /// [`Faults::jitter`].
    Jitter(Duration),
    /// [`Faults::segment_max`].
    Chop(Option<NonZeroUsize>),
    /// [`Faults::one_flip_in`].
    Corrupt(Option<NonZeroU32>),
    /// [`Faults::one_loss_in`].
    Lose(Option<NonZeroU32>),
    /// [`Faults::bytes_per_second`].
    Throttle(Option<NonZeroU64>),
    /// Ends all faults of the direction.
    Heal,
}

impl Change {
    /// Applies the change.
    pub fn apply(self, faults: &mut Faults) {
        match self {
            Self::Stall => faults.stalled = true,
            Self::Part => faults.parted = true,
            Self::Delay(delay) => faults.delay = delay,
            Self::Jitter(jitter) => faults.jitter = jitter,
            Self::Chop(segment_max) => faults.segment_max = segment_max,
            Self::Corrupt(one_flip_in) => faults.one_flip_in = one_flip_in,
            Self::Lose(one_loss_in) => faults.one_loss_in = one_loss_in,
            Self::Throttle(rate) => faults.bytes_per_second = rate,
            Self::Heal => *faults = Faults::default(),
        }
    }
}

/// The syntax that [`NetworkCommand`] is parsed from.
pub const COMMANDS: &str = "cut [fin] | refuse | accept | heal | [left|right] WHAT, where WHAT is \
    stall | part | delay MS | jitter MS | chop BYTES | corrupt ONE-FLIP-IN-BYTES | lose ONE-IN-DATAGRAMS | throttle BYTES-PER-SECOND | heal; \
    a number 0 ends what it stands for; without left or right both ways are meant, else the one that leads there";

impl FromStr for NetworkCommand {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let words: Vec<&str> = line.split_whitespace().collect();
        read(&words).ok_or_else(|| format!("{line:?} is no command; legal is {COMMANDS}"))
    }
}

fn read(words: &[&str]) -> Option<NetworkCommand> {
    Some(match words {
        ["cut"] => NetworkCommand::Cut(Cut::Reset),
        ["cut", "fin"] => NetworkCommand::Cut(Cut::Finish),
        ["refuse"] => NetworkCommand::Refuse(true),
        ["accept"] => NetworkCommand::Refuse(false),
        ["heal"] => NetworkCommand::Heal,
        ["left", what @ ..] => NetworkCommand::Change(Some(Side::Left), read_change(what)?),
        ["right", what @ ..] => NetworkCommand::Change(Some(Side::Right), read_change(what)?),
        what => NetworkCommand::Change(None, read_change(what)?),
    })
}

fn read_change(words: &[&str]) -> Option<Change> {
    let ms = |text: &str| text.parse().ok().map(Duration::from_millis);
    Some(match words {
        ["stall"] => Change::Stall,
        ["part"] => Change::Part,
        ["delay", text] => Change::Delay(ms(text)?),
        ["jitter", text] => Change::Jitter(ms(text)?),
        ["chop", text] => Change::Chop(NonZeroUsize::new(text.parse().ok()?)),
        ["corrupt", text] => Change::Corrupt(NonZeroU32::new(text.parse().ok()?)),
        ["lose", text] => Change::Lose(NonZeroU32::new(text.parse().ok()?)),
        ["throttle", text] => Change::Throttle(NonZeroU64::new(text.parse().ok()?)),
        ["heal"] => Change::Heal,
        _ => return None,
    })
}
