//! What can go wrong on the way, and the words for it.

use std::{
    num::{NonZeroU32, NonZeroU64, NonZeroUsize},
    str::FromStr,
    time::Duration,
};

/// One of the two sides between which the network is. A way is named by the side that it leads to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The one.
    Left,
    /// The other.
    Right,
}

impl Side {
    /// The side where what goes there comes from.
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

/// What goes wrong on one way. By default nothing does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Nothing passes: what comes waits, and when much waits nothing more is taken.
    pub stalled: bool,
    /// The cable is cut: bytes of connections wait, as TCP would send them again; datagrams are lost.
    pub parted: bool,
    /// Everything is later by this.
    pub delay: Duration,
    /// And by chance by up to this. Bytes of a connection stay in order, datagrams do not.
    pub jitter: Duration,
    /// Bytes of a connection that are written at once at most. Each write is a segment of its own, as a rule.
    pub segment_max: Option<NonZeroUsize>,
    /// One bit of about so many bytes is flipped.
    pub one_flip_in: Option<NonZeroU32>,
    /// One of about so many datagrams is lost, each by itself.
    pub one_loss_in: Option<NonZeroU32>,
    /// What passes at most.
    pub bytes_per_second: Option<NonZeroU64>,
}

impl Faults {
    /// Whether nothing passes now.
    pub(super) const fn is_blocked(&self) -> bool {
        self.stalled || self.parted
    }
}

/// How a connection is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    /// By RST: what was on its way is lost.
    Reset,
    /// By FIN, in both directions.
    Finish,
}

/// A word to the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Word {
    /// Cut all connections.
    Cut(Cut),
    /// Listen no more, or again.
    Refuse(bool),
    /// Let this go wrong on this way, or on both.
    Change(Option<Side>, Change),
    /// Let nothing go wrong, and listen.
    Heal,
}

/// What is to change on a way.
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
    /// All faults of the way end.
    Heal,
}

impl Change {
    /// Makes the change.
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

/// The words that [`Word`] is read from.
pub const WORDS: &str = "cut [fin] | refuse | accept | heal | [left|right] WHAT, where WHAT is \
    stall | part | delay MS | jitter MS | chop BYTES | corrupt ONE-FLIP-IN-BYTES | lose ONE-IN-DATAGRAMS | throttle BYTES-PER-SECOND | heal; \
    a number 0 ends what it stands for; without left or right both ways are meant, else the one that leads there";

impl FromStr for Word {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let words: Vec<&str> = line.split_whitespace().collect();
        read(&words).ok_or_else(|| format!("{line:?} is no word; legal is {WORDS}"))
    }
}

fn read(words: &[&str]) -> Option<Word> {
    Some(match words {
        ["cut"] => Word::Cut(Cut::Reset),
        ["cut", "fin"] => Word::Cut(Cut::Finish),
        ["refuse"] => Word::Refuse(true),
        ["accept"] => Word::Refuse(false),
        ["heal"] => Word::Heal,
        ["left", what @ ..] => Word::Change(Some(Side::Left), read_change(what)?),
        ["right", what @ ..] => Word::Change(Some(Side::Right), read_change(what)?),
        what => Word::Change(None, read_change(what)?),
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
