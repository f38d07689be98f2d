//! The reason for the end of a child.

/// The reason for the end of a child.
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
    /// The child ended itself, in order.
    Normal,
    /// The child was ordered to stop.
    Shutdown,
    /// The child panicked; the message.
    Panic(String),
    /// The child did not become ready in time.
    StartTimeout,
    /// The child cannot start now; its reason, for example a device that is not plugged in.
    StartFailed(String),
    /// The child exceeded its progress budget; the detector, the start and the activity.
    Hung(String),
    /// The child did not stop in time.
    Killed,
    /// The child's thread ended.
    ThreadEnded,
    /// The child's process ended; its exit code or signal, as a text.
    ProcessEnded(String),
    /// The child stopped in order because it lost a requirement, and is started again when that is ready; the name.
    RequirementLost(String),
    /// A supervisor gave up; the reason.
    GaveUp(String),
}

impl Reason {
    /// Returns whether this reason counts as a failure.
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
