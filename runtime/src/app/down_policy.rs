//! Policies for an application that is down: handling of messages for it, and its last wills.
//!
//! An application is down from its end, as its supervisor detects it, until its next Ready. Its node keeps a
//! [`DownState`] for it. The node reports the end and the return to the [`DownState`] on the supervisor's thread,
//! before it starts a new incarnation.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
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

/// Maximum number of last wills of one application.
pub const WILLS_MAX: usize = 8;

/// Policy for messages to an application between its end and its next Ready.
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
    /// Keeps messages, up to the mailbox's bound, and delivers them to the next incarnation in order.
    #[default]
    Hold,
    /// Rejects messages at once as [`Rejection::Down`](crate::outcome::Rejection::Down), including those that
    /// were queued when the application ended. For setpoints and other data that would be stale.
    Drop,
    /// Keeps messages for this long. After that, rejects the queued ones and all later ones, as
    /// [`Drop`](Self::Drop) does.
    HoldFor(Duration),
}

/// Selects the ends of an application after which a last will is sent.
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
    /// Sends the will after a failure: a panic, a hang, the end of its process, a missed deadline. It is not
    /// sent after an orderly end.
    #[default]
    OnDeath,
    /// Sends the will after every end.
    Always,
}

/// The recipient of a will. A name is resolved when the will is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WillRecipient {
    /// An application, a group, or all applications.
    Tid(Tid),
    /// The application that has this name when the will is sent.
    Name(String),
}

impl From<Destination<'_>> for WillRecipient {
    fn from(destination: Destination<'_>) -> Self {
        match destination {
            Destination::Tid(tid) => Self::Tid(tid),
            Destination::Name(name) => Self::Name(name.to_owned()),
        }
    }
}

impl WillRecipient {
    /// Returns the recipient as a destination for a send.
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
    /// The recipient.
    pub recipient: WillRecipient,
    /// Type of the payload.
    pub kind: Kind,
    /// The class of the message.
    pub class: Class,
    /// The payload, encoded when the will was declared.
    pub payload: Bytes,
    /// The ends after which the will is sent.
    pub when: LastWill,
}

impl Will {
    fn new<P: Payload>(when: LastWill, recipient: WillRecipient, value: &P) -> Self {
        Self { recipient, kind: P::KIND, class: P::CLASS, payload: encode(value), when }
    }

    /// Returns whether the will is sent after an end with this reason.
    #[must_use]
    pub fn applies_to(&self, reason: &Reason) -> bool {
        self.when == LastWill::Always || reason.is_failure()
    }
}

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// Sets the policy for messages to the application between its end and its next Ready. Default: messages
    /// are kept. Before its first start they are always kept.
    #[must_use]
    pub const fn while_down(mut self, policy: DownPolicy) -> Self {
        self.common.down_policy = policy;
        self
    }

    /// Adds a last will, at most 8. It is a message that is sent from the application's TID as soon as its
    /// death is detected, before a new incarnation is started. Each death sends it again. Its recipient is a
    /// name, which is resolved then, or a TID: an application, a group, or all applications.
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

    /// Same as [`last_will`](Self::last_will), for the given ends.
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

/// The state that a node keeps for one application while the application is down.
#[derive(Clone, Debug)]
pub struct DownState {
    /// The node's own sender for the application's TID: a hung incarnation may have lost its own.
    sender: Sender,
    mailbox: Arc<Mailbox>,
    policy: DownPolicy,
    wills: Arc<[Will]>,
    /// Counts ends and returns, so that a late timer does not act after a later end.
    turn: Arc<AtomicU64>,
    /// Whether the application has been ready since its last end.
    was_ready: Arc<AtomicBool>,
}

impl DownState {
    pub(super) fn new(
        AppWiring { sender, mailbox }: AppWiring,
        policy: DownPolicy,
        wills: Vec<Will>,
    ) -> Self {
        Self { sender, mailbox, policy, wills: wills.into(), turn: Arc::default(), was_ready: Arc::default() }
    }

    /// The application's TID.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.sender.tid()
    }

    /// The last wills of the application.
    #[must_use]
    pub fn wills(&self) -> Arc<[Will]> {
        self.wills.clone()
    }

    /// Handles the end of an incarnation: applies the policy to the mailbox and sends each last will once.
    /// The wills arrive after all messages that this incarnation sent in the same class. A will that no queue
    /// accepts is logged, and counted by the router.
    ///
    /// A start that [failed by an explicit call](Reason::StartFailed) does not end an incarnation that was
    /// ready, so it changes nothing. Otherwise an application without its device would send its last wills at
    /// each retry.
    ///
    /// Must run on an actix thread if [`DownPolicy::HoldFor`] is used.
    pub fn on_end(&self, reason: &Reason) {
        // SYNC: Relaxed; `on_end`, `on_ready` and the timer between them run on one thread.
        let was_ready = self.was_ready.swap(false, Ordering::Relaxed);
        if !was_ready && matches!(reason, Reason::StartFailed(_)) {
            return self.mailbox.forget_events();
        }
        let turn = self.turn.fetch_add(1, Ordering::Relaxed) + 1;
        self.mailbox.forget_events();
        match self.policy {
            DownPolicy::Hold => {}
            DownPolicy::Drop => self.mailbox.refuse_while_down(),
            DownPolicy::HoldFor(time) => self.refuse_after(time, turn),
        }
        for will in self.wills.iter().filter(|will| will.applies_to(reason)) {
            if let Err(error) = self.execute(will) {
                crate::log::error!(tid = %self.tid(), recipient = ?will.recipient, %error, "a last will was rejected");
            }
        }
    }

    /// Handles the next Ready of the application.
    pub fn on_ready(&self) {
        self.was_ready.store(true, Ordering::Relaxed);
        self.turn.fetch_add(1, Ordering::Relaxed);
        self.mailbox.accept_again();
    }

    fn execute(&self, will: &Will) -> Result<(), SendError> {
        self.sender.send_bytes(will.recipient.destination(), will.kind, will.class, will.payload.clone())
    }

    fn refuse_after(&self, time: Duration, turn: u64) {
        let state = self.clone();
        actix_rt::spawn(async move {
            tokio::time::sleep(time).await;
            if state.turn.load(Ordering::Relaxed) == turn {
                state.mailbox.refuse_while_down();
            }
        });
    }
}
