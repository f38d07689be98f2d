//! How a child ended.

/// How a child ended.
///
/// # Examples
///
/// ```
/// use sinew::supervision::Reason;
///
/// assert!(Reason::Hung("in a handler".to_owned()).is_failure());
/// assert!(!Reason::RequirementLost("imu".to_owned()).is_failure());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// By itself, in order.
    Normal,
    /// Because it was told to.
    Shutdown,
    /// It panicked; what it said.
    Panic(String),
    /// It did not become ready in its time.
    StartTimeout,
    /// It cannot start now and said why: a device that is not plugged in, for example.
    StartFailed(String),
    /// It did not come back in its progress budget; who says so, since when, and in what.
    Hung(String),
    /// It did not stop in its time.
    Killed,
    /// The thread under it ended.
    ThreadEnded,
    /// The process that it was ended; its exit code or the signal, in words.
    ProcessEnded(String),
    /// It stopped in order because it lost what it requires, to be started again when that is there; the name.
    RequirementLost(String),
    /// A supervisor gave up; why.
    GaveUp(String),
}

impl Reason {
    /// Whether this counts as a failure.
    #[must_use]
    pub const fn is_failure(&self) -> bool {
        !matches!(self, Self::Normal | Self::Shutdown | Self::RequirementLost(_))
    }
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Normal => f.write_str("ended by itself"),
            Self::Shutdown => f.write_str("was told to stop"),
            Self::Panic(said) => write!(f, "panicked: {said}"),
            Self::StartTimeout => f.write_str("did not become ready in its time"),
            Self::StartFailed(why) => write!(f, "cannot start: {why}"),
            Self::Hung(what) => write!(f, "hung: {what}"),
            Self::Killed => f.write_str("did not stop in its time"),
            Self::ThreadEnded => f.write_str("lost its thread"),
            Self::ProcessEnded(how) => write!(f, "its process ended: {how}"),
            Self::RequirementLost(name) => write!(f, "stopped because it lost what it requires: {name}"),
            Self::GaveUp(why) => write!(f, "gave up: {why}"),
        }
    }
}
