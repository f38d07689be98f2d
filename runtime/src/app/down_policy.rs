//! While an application is away: what becomes of messages for it, and what is said on its behalf when it has died.
//!
//! An application is away from its end, as its supervisor knows it, until its next Ready. Its node keeps an [`Absence`]
//! for it, and tells it of both, on the supervisor's thread and before a new life is started.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use actix::Actor;
use bytes::Bytes;

use crate::{
    app::{AppContext, AppSpec, AppWiring},
    mailbox::Mailbox,
    sender::{Destination, SendError, Sender},
    supervision::Reason,
    tid::Tid,
    wire::{Class, Kind, Payload, encode},
};

/// Last wills of one application at most.
pub const WILLS_MAX: usize = 8;

/// What becomes of messages for an application between its end and its next Ready.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Drive;
/// # impl Actor for Drive { type Context = AppContext<Self>; }
///
/// // A setpoint that waited for a restart is stale.
/// let drive = AppSpec::new("knee.drive", || Drive).while_down(DownPolicy::Drop);
/// // A recorder may take up to 2 s to come back.
/// # struct Recorder;
/// # impl Actor for Recorder { type Context = AppContext<Self>; }
/// let recorder = AppSpec::new("recorder", || Recorder).while_down(DownPolicy::HoldFor(Duration::from_secs(2)));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DownPolicy {
    /// They are kept, up to the mailbox's bound, and handed to its next life in order.
    #[default]
    Hold,
    /// They are refused at once as [`Rejection::Down`](crate::outcome::Rejection::Down), those too that waited when it
    /// ended: for setpoints and whatever else would be stale.
    Drop,
    /// They are kept for this long; from then on, and with those that wait by then, as [`Drop`](Self::Drop).
    HoldFor(Duration),
}

/// When a last will is sent.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.offline" => struct Offline;);
/// struct Knee;
/// # impl Actor for Knee { type Context = AppContext<Self>; }
///
/// // Sent also where the knee stops in order.
/// let knee = AppSpec::new("knee", || Knee).last_will_when(LastWill::Always, "gait", &Offline);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LastWill {
    /// When it died: by a panic, a hang, its process's end, a missed deadline. Not when it ended in order.
    #[default]
    OnDeath,
    /// Whenever it has ended.
    Always,
}

/// Whom a will is for. A name is looked up when the will is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heir {
    /// An application, a group, everybody.
    Tid(Tid),
    /// Whoever has this name then.
    Name(String),
}

impl From<Destination<'_>> for Heir {
    fn from(destination: Destination<'_>) -> Self {
        match destination {
            Destination::Tid(tid) => Self::Tid(tid),
            Destination::Name(name) => Self::Name(name.to_owned()),
        }
    }
}

impl Heir {
    /// The same, to send to.
    #[must_use]
    pub fn destination(&self) -> Destination<'_> {
        match self {
            Self::Tid(tid) => Destination::Tid(*tid),
            Self::Name(name) => Destination::Name(name),
        }
    }
}

/// A message that is sent on behalf of an application that has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Will {
    /// To whom.
    pub heir: Heir,
    /// Type of the payload.
    pub kind: Kind,
    /// In which class it travels.
    pub class: Class,
    /// The payload as it was when the will was made.
    pub payload: Bytes,
    /// After which ends.
    pub when: LastWill,
}

impl Will {
    fn new<P: Payload>(when: LastWill, heir: Heir, value: &P) -> Self {
        Self { heir, kind: P::KIND, class: P::CLASS, payload: encode(value), when }
    }

    /// Whether it is sent after an end of this kind.
    #[must_use]
    pub fn applies_to(&self, reason: &Reason) -> bool {
        self.when == LastWill::Always || reason.is_failure()
    }
}

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// What becomes of messages for it between its end and its next Ready. Default: they are kept. Before its first
    /// start they are kept whatever is said here.
    #[must_use]
    pub const fn while_down(mut self, away: DownPolicy) -> Self {
        self.common.away = away;
        self
    }

    /// A message that is sent from its TID the moment that it is known dead, before a new life is started; at most 8.
    /// Where it dies again, it is sent again. Its heir is a name, which is looked up then, or a TID: an application, a
    /// group, everybody.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.stop" => struct Stop;);
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// // Where the gait dies, its node stops the drives on its behalf.
    /// let gait = AppSpec::new("gait", || Gait).last_will(Tid::group("drives"), &Stop);
    /// ```
    #[must_use]
    pub fn last_will<'a, P: Payload>(self, to: impl Into<Destination<'a>>, value: &P) -> Self {
        self.last_will_when(LastWill::OnDeath, to, value)
    }

    /// The same, saying after which ends.
    #[must_use]
    pub fn last_will_when<'a, P: Payload>(
        mut self,
        when: LastWill,
        to: impl Into<Destination<'a>>,
        value: &P,
    ) -> Self {
        self.common.wills.push(Will::new(when, to.into().into(), value));
        self
    }
}

/// What a node keeps of one application for the time that it is away.
#[derive(Clone, Debug)]
pub struct Absence {
    /// The node's own sending side of the application's TID: a life that hangs may have lost its own.
    sender: Sender,
    mailbox: Arc<Mailbox>,
    away: DownPolicy,
    wills: Arc<[Will]>,
    /// Counts ends and returns, so that a late timer does not speak for a later absence.
    turn: Arc<AtomicU64>,
}

impl Absence {
    pub(super) fn new(AppWiring { sender, mailbox }: AppWiring, away: DownPolicy, wills: Vec<Will>) -> Self {
        Self { sender, mailbox, away, wills: wills.into(), turn: Arc::default() }
    }

    /// The application's TID.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.sender.tid()
    }

    /// Its last wills.
    #[must_use]
    pub fn wills(&self) -> Arc<[Will]> {
        self.wills.clone()
    }

    /// Its life has ended: its mailbox does as declared, and its last wills are sent, each once. They come after all that
    /// this life has sent in the same class. A will that nobody takes is logged, and counted by the router.
    ///
    /// Called on a thread of actix's where [`DownPolicy::HoldFor`] is used.
    pub fn begins(&self, reason: &Reason) {
        // SYNC: Relaxed; begins, ends and the timer between them run on one thread.
        let turn = self.turn.fetch_add(1, Ordering::Relaxed) + 1;
        self.mailbox.forget_events();
        match self.away {
            DownPolicy::Hold => {}
            DownPolicy::Drop => self.mailbox.refuse_while_away(),
            DownPolicy::HoldFor(time) => self.refuse_after(time, turn),
        }
        for will in self.wills.iter().filter(|will| will.applies_to(reason)) {
            if let Err(error) = self.execute(will) {
                crate::log::error!(tid = %self.tid(), heir = ?will.heir, %error, "a last will was not taken");
            }
        }
    }

    /// It is ready again.
    pub fn ends(&self) {
        self.turn.fetch_add(1, Ordering::Relaxed);
        self.mailbox.is_back();
    }

    fn execute(&self, will: &Will) -> Result<(), SendError> {
        self.sender.send_bytes(will.heir.destination(), will.kind, will.class, will.payload.clone())
    }

    fn refuse_after(&self, time: Duration, turn: u64) {
        let absence = self.clone();
        actix_rt::spawn(async move {
            tokio::time::sleep(time).await;
            if absence.turn.load(Ordering::Relaxed) == turn {
                absence.mailbox.refuse_while_away();
            }
        });
    }
}
