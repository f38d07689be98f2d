//! What an application does when it loses what it requires: carry on, pause, go to its safe state, or start anew.

use std::{cell::RefCell, collections::BTreeSet, rc::Rc, sync::Arc};

use actix::{Actor, ActorContext};
use serde::{Deserialize, Serialize};

use crate::{
    app::{AppContext, AppSpec},
    supervision::{Life, Reason},
    tid::AppAddress,
    time::Time,
    wire::{Class, Message, Payload},
};

/// A requirement changed. Applications that require something and handle this payload get it from their node's sync
/// manager, ahead of every message that waits for them.
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
    /// What this application requires is not ready any more.
    Lost {
        /// The requirement's text: the name, where it is one.
        name: String,
    },
    /// It is ready again.
    Met {
        /// The requirement's text.
        name: String,
    },
    /// What this application can do without ([`Requirement::or_after`](crate::app::Requirement::or_after)) is not there: it was
    /// started without it, or it went later. No policy applies. `Met` follows when it is there.
    Without {
        /// The requirement's text.
        name: String,
    },
}

impl RequirementEvent {
    /// The text of the requirement that is lost, met or missing.
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

/// What an application does when it loses what it requires. Whatever it is, its `Handler<Delivery<RequirementEvent>>`
/// is called as well, if it declares one, after what stands here.
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
    /// It goes on as before.
    #[default]
    CarryOn,
    /// No message is handled and no timer of its context fires until all is met again. Messages are kept, up to the
    /// mailbox's bound; periods go on on their grid, without a turn for the time between; input watchdogs count as if
    /// that time had not been. A stop works as ever. Futures that it spawned are not paused.
    Pause,
    /// Its safe state, declared with [`AppSpec::safe_state`], is entered at once; it is left when all is met again.
    SafeState,
    /// It is stopped in order, and started anew when all that it requires is ready. That is no failure: it is not counted
    /// among the restarts, and no last will is sent but for those that are always.
    Restart,
}

type Change<A> = Arc<dyn Fn(&mut A, &RequirementEvent, &mut AppContext<A>) + Send + Sync>;

/// How an application enters and leaves its safe state.
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
    /// What it does when it loses what it requires. Default: it carries on.
    #[must_use]
    pub const fn on_requirement_lost(mut self, policy: RequirementPolicy) -> Self {
        self.common.on_lost = policy;
        self
    }

    /// When it loses what it requires, `enter` is called, once for each name, ahead of every message that waits; when all
    /// is met again, `leave`. Between them it handles messages as ever.
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

/// Says how a life ended that ended itself because of its policy.
pub(super) type Parting = Rc<RefCell<Option<Reason>>>;

/// What one life knows of its requirements, and does about them.
pub(super) struct Requirements<A: Actor<Context = AppContext<A>>> {
    policy: RequirementPolicy,
    safe_state: Option<SafeState<A>>,
    /// The names that are not ready, as far as it was told.
    lost: BTreeSet<String>,
    /// The same of what it can do without.
    without: BTreeSet<String>,
    paused: Option<Time>,
    parting: Parting,
}

impl<A: Actor<Context = AppContext<A>>> Requirements<A> {
    pub(super) fn new(policy: RequirementPolicy, safe_state: Option<SafeState<A>>, parting: Parting) -> Self {
        Self { policy, safe_state, lost: BTreeSet::new(), without: BTreeSet::new(), paused: None, parting }
    }

    /// Whether neither messages nor timers are handled.
    pub(super) const fn is_paused(&self) -> bool {
        self.paused.is_some()
    }

    /// Takes note of a change and does what the policy says. Returns whether it is news to this life: an event that was
    /// meant for the life before may be left.
    pub(super) fn take(
        &mut self,
        actor: &mut A,
        context: &mut AppContext<A>,
        event: &RequirementEvent,
        now: Time,
    ) -> bool {
        match event {
            RequirementEvent::Lost { name } => {
                let is_news = self.lost.insert(name.clone());
                if is_news {
                    self.on_lost(actor, context, event, now);
                }
                is_news
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
                *self.parting.borrow_mut() = Some(Reason::RequirementLost(event.name().to_owned()));
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

/// The event in a message, if it is the word of this node's sync manager and not of somebody who says it by that name.
pub(super) fn event_in<A: Actor<Context = AppContext<A>>>(
    context: &AppContext<A>,
    message: &Message,
) -> Option<RequirementEvent> {
    let source = message.header.source;
    let is_ours = source.app == AppAddress::SYNC && source.node == context.tid().node;
    if message.header.kind == RequirementEvent::KIND && is_ours { message.decode().ok() } else { None }
}

/// An application whose factory could not make its actor.
pub(super) struct Unmade(pub(super) String);

impl Life for Unmade {
    fn poll(&mut self, _: &mut std::task::Context<'_>) -> std::task::Poll<Reason> {
        std::task::Poll::Ready(Reason::StartFailed(std::mem::take(&mut self.0)))
    }

    fn stop(&mut self) {}

    fn terminate(&mut self) {}
}

/// A life that may say itself how it ended.
pub(super) struct PartingLife {
    pub(super) life: Box<dyn Life>,
    pub(super) parting: Parting,
}

impl Life for PartingLife {
    fn poll(&mut self, cx: &mut std::task::Context<'_>) -> std::task::Poll<Reason> {
        self.life.poll(cx).map(|reason| self.parting.borrow_mut().take().unwrap_or(reason))
    }

    fn stop(&mut self) {
        self.life.stop();
    }

    fn terminate(&mut self) {
        self.life.terminate();
    }
}
