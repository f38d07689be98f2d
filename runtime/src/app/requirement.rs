//! The reaction of an application to the loss of a requirement: carry on, pause, enter the safe state, or restart.

use std::{cell::RefCell, collections::BTreeSet, rc::Rc, sync::Arc};

use actix::{Actor, ActorContext};
use serde::{Deserialize, Serialize};

use crate::{
    app::{AppContext, AppSpec},
    supervision::{Reason, RunningActor},
    tid::AppAddress,
    time::Time,
    wire::{Class, Message, Payload},
};

/// A change of a requirement. An application that has requirements and handles this payload receives it from
/// its node's sync manager, ahead of all queued messages.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Gait { cautious: bool }
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<RequirementEvent>> for Gait {
///     type Result = ();
///     fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
///         match &event.payload {
///             RequirementEvent::Met { .. } => self.cautious = false,
///             RequirementEvent::Lost { name } | RequirementEvent::Without { name } => {
///                 println!("{name} is not there");
///                 self.cautious = true;
///             }
///         }
///     }
/// }
///
/// let gait = AppSpec::new("gait", || Gait { cautious: false })
///     .requires(["knee.drive", "camera ?2s"])
///     .handles::<RequirementEvent>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RequirementEvent {
    /// A requirement of this application is no longer ready.
    Lost {
        /// The text of the requirement: the name, if the requirement is one name.
        name: String,
    },
    /// The requirement is ready again.
    Met {
        /// The text of the requirement.
        name: String,
    },
    /// An optional requirement of this application
    /// ([`Requirement::or_after`](crate::app::Requirement::or_after)) is not ready. The application was
    /// started without it, or it was lost later. No policy applies. `Met` follows when it is ready.
    Without {
        /// The text of the requirement.
        name: String,
    },
}

impl RequirementEvent {
    /// Returns the text of the requirement that is lost, met or missing.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Lost { name } | Self::Met { name } | Self::Without { name } => name,
        }
    }
}

impl Payload for RequirementEvent {
    const NAME: &'static str = "sinew.requirement_event";
    const CLASS: Class = Class::Control;
}

/// Policy for the loss of a requirement. In every case the application's
/// `Handler<Delivery<RequirementEvent>>`, if it declares one, is called after the policy was applied.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Gait;
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// // Without its sensor the gait handles nothing, and its timers rest.
/// let gait = AppSpec::new("gait", || Gait).requires(["imu"]).on_requirement_lost(RequirementPolicy::Pause);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RequirementPolicy {
    /// Continues without a change.
    #[default]
    CarryOn,
    /// Pauses the application until all requirements are met again: no message is handled, and no timer of
    /// its context fires. Messages are kept, up to the mailbox's bound. Periodic timers keep their grid and
    /// skip the turns of the pause. Input watchdogs do not count the pause. An order to stop is executed as
    /// usual. Futures that the application spawned are not paused.
    Pause,
    /// Enters the safe state, declared with [`AppSpec::safe_state`], at once, and leaves it when all
    /// requirements are met again.
    SafeState,
    /// Stops the application in order and starts it again when all its requirements are ready. This is no
    /// failure: it does not count as a restart, and only the last wills with
    /// [`LastWill::Always`](crate::app::LastWill::Always) are sent.
    Restart,
}

type Change<A> = Arc<dyn Fn(&mut A, &RequirementEvent, &mut AppContext<A>) + Send + Sync>;

/// The functions that enter and leave the safe state of an application.
pub(super) struct SafeState<A: Actor<Context = AppContext<A>>> {
    enter: Change<A>,
    leave: Change<A>,
}

impl<A: Actor<Context = AppContext<A>>> Clone for SafeState<A> {
    fn clone(&self) -> Self {
        Self { enter: self.enter.clone(), leave: self.leave.clone() }
    }
}

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// Sets the policy for the loss of a requirement. Default: the application carries on.
    #[must_use]
    pub const fn on_requirement_lost(mut self, policy: RequirementPolicy) -> Self {
        self.common.on_lost = policy;
        self
    }

    /// Declares a safe state. `enter` is called when requirements are lost, once for each name, ahead of all
    /// queued messages. `leave` is called when all are met again. Between them the application handles
    /// messages as usual.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Drive { limit: f32 }
    /// # impl Actor for Drive { type Context = AppContext<Self>; }
    ///
    /// let drive = AppSpec::new("knee.drive", || Drive { limit: 40.0 }).requires(["gait"]).safe_state(
    ///     |drive, lost, _| {
    ///         println!("{} is lost", lost.name());
    ///         drive.limit = 0.0;
    ///     },
    ///     |drive, _, _| drive.limit = 40.0,
    /// );
    /// ```
    #[must_use]
    pub fn safe_state(
        mut self,
        enter: impl Fn(&mut A, &RequirementEvent, &mut AppContext<A>) + Send + Sync + 'static,
        leave: impl Fn(&mut A, &RequirementEvent, &mut AppContext<A>) + Send + Sync + 'static,
    ) -> Self {
        self.safe_state = Some(SafeState { enter: Arc::new(enter), leave: Arc::new(leave) });
        self.on_requirement_lost(RequirementPolicy::SafeState)
    }
}

/// The end reason of an incarnation that stopped itself because of its policy.
pub(super) type EndReason = Rc<RefCell<Option<Reason>>>;

/// The requirements of one incarnation as far as it knows them, and its policy for their loss.
pub(super) struct Requirements<A: Actor<Context = AppContext<A>>> {
    policy: RequirementPolicy,
    safe_state: Option<SafeState<A>>,
    /// The names that are not ready, according to the events received so far.
    lost: BTreeSet<String>,
    /// The optional requirements that are not ready.
    without: BTreeSet<String>,
    paused: Option<Time>,
    end_reason: EndReason,
}

impl<A: Actor<Context = AppContext<A>>> Requirements<A> {
    pub(super) fn new(
        policy: RequirementPolicy,
        safe_state: Option<SafeState<A>>,
        end_reason: EndReason,
    ) -> Self {
        Self { policy, safe_state, lost: BTreeSet::new(), without: BTreeSet::new(), paused: None, end_reason }
    }

    /// Returns whether the handling of messages and timers is paused.
    pub(super) const fn is_paused(&self) -> bool {
        self.paused.is_some()
    }

    /// Records a change and applies the policy. Returns whether the change is new to this incarnation: an
    /// event for the previous incarnation may still be queued.
    pub(super) fn take(
        &mut self,
        actor: &mut A,
        context: &mut AppContext<A>,
        event: &RequirementEvent,
        now: Time,
    ) -> bool {
        match event {
            RequirementEvent::Lost { name } => {
                let is_new = self.lost.insert(name.clone());
                if is_new {
                    self.on_lost(actor, context, event, now);
                }
                is_new
            }
            RequirementEvent::Met { name } => {
                let was_lost = self.lost.remove(name);
                if was_lost && self.lost.is_empty() {
                    self.on_all_met(actor, context, event, now);
                }
                self.without.remove(name) || was_lost
            }
            RequirementEvent::Without { name } => self.without.insert(name.clone()),
        }
    }

    fn on_lost(&mut self, actor: &mut A, context: &mut AppContext<A>, event: &RequirementEvent, now: Time) {
        match self.policy {
            RequirementPolicy::CarryOn => {}
            RequirementPolicy::Pause => {
                self.paused.get_or_insert(now);
            }
            RequirementPolicy::SafeState => {
                if let Some(SafeState { enter, .. }) = &self.safe_state {
                    enter(actor, event, context);
                }
            }
            RequirementPolicy::Restart => {
                *self.end_reason.borrow_mut() = Some(Reason::RequirementLost(event.name().to_owned()));
                context.stop();
            }
        }
    }

    fn on_all_met(
        &mut self,
        actor: &mut A,
        context: &mut AppContext<A>,
        event: &RequirementEvent,
        now: Time,
    ) {
        if let Some(since) = self.paused.take() {
            context.resume(since, now);
        }
        if let Some(SafeState { leave, .. }) = &self.safe_state {
            leave(actor, event, context);
        }
    }
}

/// Returns the event in a message, if the message is from this node's sync manager and not from another
/// sender that uses its kind.
pub(super) fn event_in<A: Actor<Context = AppContext<A>>>(
    context: &AppContext<A>,
    message: &Message,
) -> Option<RequirementEvent> {
    let source = message.header.source;
    let is_ours = source.app == AppAddress::SYNC && source.node == context.tid().node;
    if message.header.kind == RequirementEvent::KIND && is_ours { message.decode().ok() } else { None }
}

/// An application without an actor, because its factory failed.
pub(super) struct FailedStart(pub(super) String);

impl RunningActor for FailedStart {
    fn poll(&mut self, _: &mut std::task::Context<'_>) -> std::task::Poll<Reason> {
        std::task::Poll::Ready(Reason::StartFailed(std::mem::take(&mut self.0)))
    }

    fn stop(&mut self) {}

    fn terminate(&mut self) {}
}

/// An incarnation that may set its own end reason.
pub(super) struct WithEndReason {
    pub(super) actor: Box<dyn RunningActor>,
    pub(super) end_reason: EndReason,
}

impl RunningActor for WithEndReason {
    fn poll(&mut self, cx: &mut std::task::Context<'_>) -> std::task::Poll<Reason> {
        self.actor.poll(cx).map(|reason| self.end_reason.borrow_mut().take().unwrap_or(reason))
    }

    fn stop(&mut self) {
        self.actor.stop();
    }

    fn terminate(&mut self) {
        self.actor.terminate();
    }
}
