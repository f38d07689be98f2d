//! One topic from ROS to Sinew: commands, each of which is let through by a rule or refused.

use std::{fmt, sync::Arc, time::Duration};

use crate::{
    attachment::Attachment,
    catalog::Structure,
    cdr::{MESSAGE_BYTES_MAX, decode},
    convert::to_sinew,
    pace::Pace,
    path::{Expression, Target},
    payload::Payload,
};

/// Why a message of ROS did not become one of Sinew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// No rule has the topic.
    NoRule,
    /// The rule of the topic has another type, or another version of it.
    OtherType,
    /// It is longer than the maximum.
    TooLong,
    /// Its bytes are none of its type, or a number is not finite.
    Malformed,
    /// It came before the rate of the rule allows it.
    TooOften,
    /// It was sent too long ago, or has no time.
    TooOld,
    /// Too many messages wait to be sent.
    QueueFull,
    /// Its receiver takes this type only protected, and the rule has no `protected`.
    Unprotected,
    /// The receiver is not known now, or the node has not taken the message.
    NotSent,
    /// The receiver, or its node, has refused it.
    Refused,
}

impl Cause {
    /// All causes, in the order of [`Cause::place`].
    pub const ALL: [Self; 10] = [
        Self::NoRule,
        Self::OtherType,
        Self::TooLong,
        Self::Malformed,
        Self::TooOften,
        Self::TooOld,
        Self::QueueFull,
        Self::Unprotected,
        Self::NotSent,
        Self::Refused,
    ];

    /// Returns the place in [`Cause::ALL`].
    #[must_use]
    pub const fn place(self) -> usize {
        self as usize
    }

    /// Returns the name in logs and counts.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::NoRule => "no rule",
            Self::OtherType => "other type",
            Self::TooLong => "too long",
            Self::Malformed => "malformed",
            Self::TooOften => "too often",
            Self::TooOld => "too old",
            Self::QueueFull => "queue full",
            Self::Unprotected => "unprotected",
            Self::NotSent => "not sent",
            Self::Refused => "refused by the receiver",
        }
    }
}

/// A message of ROS that is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The cause.
    pub cause: Cause,
    /// The details, with the remedy.
    pub detail: String,
}

impl Refusal {
    /// Returns a refusal.
    pub fn new(cause: Cause, detail: impl Into<String>) -> Self {
        Self { cause, detail: detail.into() }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.cause.name(), self.detail)
    }
}

/// The receiver of commands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Receiver {
    /// The application of this name.
    App(String),
    /// The members of the group of this name.
    Group(String),
}

impl fmt::Display for Receiver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::App(name) => write!(f, "{name}"),
            Self::Group(name) => write!(f, "the group {name}"),
        }
    }
}

/// The class of the messages of a rule.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SendClass {
    /// In order, each one.
    #[default]
    Control,
    /// The newest one.
    Stream,
    /// In order, behind all others.
    Bulk,
}

/// The limits of a protected type, as its definition in Sinew has them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SealLimits {
    /// Maximum time from one good command to the next.
    pub within_ms: u32,
    /// Maximum age of a command.
    pub age_max_ms: u32,
    /// Maximum number of lost commands in a row.
    pub lost_max: u64,
    /// Maximum number of bad commands in a row.
    pub bad_max: u32,
    /// Number of good commands in a row before the output may be armed.
    pub good_min: u32,
}

/// A topic with commands.
#[derive(Clone, Debug)]
pub struct Incoming {
    /// The topic.
    pub topic: String,
    /// The type.
    pub message: Arc<Structure>,
    /// The type of Sinew.
    pub type_name: String,
    /// The receiver.
    pub to: Receiver,
    /// The class.
    pub class: SendClass,
    /// The limits of the type, if it is protected.
    pub protected: Option<SealLimits>,
    fields: Vec<(Vec<String>, Target, Expression)>,
    /// Fields that are the same in each message.
    base: Payload,
    pace: Pace,
    max_age: Option<Duration>,
}

/// The fields of a rule from ROS.
#[derive(Clone, Debug)]
pub(crate) struct Fields {
    pub(crate) taken: Vec<(Vec<String>, Target, Expression)>,
    pub(crate) constants: Vec<(Vec<String>, Payload)>,
}

/// The receiver of a rule from ROS, and how it is sent to.
#[derive(Clone, Debug)]
pub(crate) struct Sending {
    pub(crate) type_name: String,
    pub(crate) to: Receiver,
    pub(crate) class: SendClass,
    pub(crate) protected: Option<SealLimits>,
}

impl Incoming {
    pub(crate) fn new(
        topic: String,
        message: Arc<Structure>,
        Sending { type_name, to, class, protected }: Sending,
        Fields { taken: fields, constants }: Fields,
        (period, max_age): (Duration, Option<Duration>),
    ) -> Self {
        let mut base = Payload::Map(Vec::new());
        for (names, constant) in constants {
            put(&mut base, &names, constant);
        }
        let pace = Pace::new(period);
        Self { topic, message, type_name, to, class, protected, fields, base, pace, max_age }
    }

    /// Returns the payload of a command for a message of ROS. `now` is the host's monotonic clock, `wall_ns` its wall
    /// clock.
    ///
    /// # Errors
    /// The message is refused.
    pub fn take(
        &mut self,
        bytes: &[u8],
        attachment: Option<&[u8]>,
        now: Duration,
        wall_ns: i64,
    ) -> Result<Vec<u8>, Refusal> {
        if bytes.len() > MESSAGE_BYTES_MAX {
            let detail = format!("{} bytes, and at most {MESSAGE_BYTES_MAX} are read", bytes.len());
            return Err(Refusal::new(Cause::TooLong, detail));
        }
        self.check_age(attachment, wall_ns)?;
        let malformed = |why: String| Refusal::new(Cause::Malformed, why);
        let value = decode(&self.message, bytes).map_err(|why| malformed(why.to_string()))?;
        let mut payload = self.base.clone();
        for (names, target, expression) in &self.fields {
            let absent = || malformed(format!("it has no {}", expression.path));
            let found = target.get(&value).ok_or_else(absent)?;
            let member = to_sinew(found, expression)
                .map_err(|why| malformed(format!("{}: {why}", expression.path)))?;
            put(&mut payload, names, member);
        }
        let payload = payload.write().map_err(|why| malformed(why.to_string()))?;
        // Last: a message that is refused for another reason uses up nothing of the rate.
        if self.pace.take(now) {
            Ok(payload)
        } else {
            Err(Refusal::new(Cause::TooOften, "more messages than rate_hz of the rule allows"))
        }
    }

    /// Returns the maximum age of a message, if the rule has one.
    #[must_use]
    pub const fn max_age(&self) -> Option<Duration> {
        self.max_age
    }

    fn check_age(&self, attachment: Option<&[u8]>, wall_ns: i64) -> Result<(), Refusal> {
        let Some(max) = self.max_age else { return Ok(()) };
        let old = |detail: String| Refusal::new(Cause::TooOld, detail);
        let attachment = attachment.ok_or_else(|| old("it has no attachment with its time".to_owned()))?;
        let attachment = Attachment::parse(attachment).map_err(|why| old(why.to_string()))?;
        let age = i128::from(wall_ns) - i128::from(attachment.time_ns);
        if age.unsigned_abs() <= max.as_nanos() {
            return Ok(());
        }
        Err(old(format!(
            "it was sent {} ms ago by the wall clocks, and max_age_ms is {}; are the clocks of both hosts synchronised?",
            age / 1_000_000,
            max.as_millis()
        )))
    }
}

/// Sets a field of a payload, in structures that are made for it.
fn put(payload: &mut Payload, names: &[String], value: Payload) {
    let Some((name, rest)) = names.split_first() else {
        *payload = value;
        return;
    };
    if !matches!(payload, Payload::Map(_)) {
        *payload = Payload::Map(Vec::new());
    }
    let Payload::Map(members) = payload else { return };
    let at = members.iter().position(|(known, _)| known == name).unwrap_or_else(|| {
        members.push((name.clone(), Payload::Nil));
        members.len() - 1
    });
    put(&mut members[at].1, rest, value);
}
