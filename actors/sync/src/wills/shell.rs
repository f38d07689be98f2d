//! Executes the outputs of the will core, on the thread that reports an event. The caller must hold no lock
//! of the node.

use sinew_model::{
    facts::{LinkFact, LossReason, MembershipFact},
    ports::NodeIncarnation,
};
use sinew_runtime::{
    app::WillRecipient,
    lock,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message, decode},
};

use super::{
    core::{Input, Output},
    protocol::{HeldWill, Testament},
};
use crate::State;

impl Input {
    /// Returns the input that a membership event is for wills. Returns `None` if the event does not concern
    /// them.
    pub const fn of_membership(fact: &MembershipFact) -> Option<Self> {
        match *fact {
            MembershipFact::NodeFound { .. } => None,
            MembershipFact::NodeLost { node, incarnation, why: LossReason::Left } => {
                Some(Self::NodeLeft { node, incarnation })
            }
            MembershipFact::NodeLost {
                node,
                incarnation,
                why: LossReason::Crashed | LossReason::Hung | LossReason::LinkDown | LossReason::Restarted,
            } => Some(Self::NodeLost { node, incarnation }),
            MembershipFact::NodeLost { node, incarnation, why: LossReason::GaveUp(_) } => {
                Some(Self::GaveUp { node, incarnation })
            }
            MembershipFact::NodeLost { node, incarnation, why: LossReason::Duplicate } => {
                Some(Self::Duplicate { node, incarnation })
            }
        }
    }

    /// Returns the input that a link event is for wills. Returns `None` if the event does not concern them.
    pub fn of_link(fact: &LinkFact) -> Option<Self> {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => Some(Self::LinkUp { node, incarnation }),
            LinkFact::LinkBroken { node, incarnation } => Some(Self::LinkBroken { node, incarnation }),
            // A node sends its goodbye on a link after the wills that it has executed, also when it gives up.
            LinkFact::PeerLeft { node, incarnation, gave_up: _ } => {
                Some(Self::NodeLeft { node, incarnation })
            }
            LinkFact::DialRefused { .. } => None,
        }
    }
}

/// Passes an input to the core and executes the outputs.
pub fn feed(state: &State, input: Input) {
    let is_earlier = {
        let mut core = lock(&state.wills);
        let before = core.next_wake();
        core.handle(Time::now(), input);
        core.next_wake().is_some_and(|wake| before.is_none_or(|before| wake < before))
    };
    loop {
        let Some(output) = lock(&state.wills).poll() else { break };
        match output {
            Output::Publish { to, testament, left_out } => {
                if left_out > 0 {
                    let detail = format!(
                        "{left_out} last wills of this node's applications are not held by other nodes: there are more than 256, or \
                         they are longer than `node.payload_max` together; raise it, or write shorter ones"
                    );
                    state.ctx.refusals.count(Time::now(), "wills", &detail);
                }
                publish(state, to, &testament);
            }
            Output::Execute { node, incarnation, will } => execute(state, (node, incarnation), &will),
        }
    }
    if is_earlier && state.ctx.event_queues.sync.post(crate::Event::Monitors).is_err() {
        sinew_runtime::log::error!(
            "the sync manager's event queue is full; wills are sent late: does it hang?"
        );
    }
}

/// Returns the time at which the sync manager must pass `TimePassed` to the core.
pub fn next_wake(state: &State) -> Option<Time> {
    lock(&state.wills).next_wake()
}

/// Handles the wills of another node.
///
/// # Errors
/// Returns a description of the fault if the wills are invalid.
pub fn receive(state: &State, from: NodeAddress, message: &Message) -> Result<(), String> {
    let testament: Testament =
        decode(&message.payload).map_err(|error| format!("from {from}, wills: {error}"))?;
    if !testament.wills.iter().all(|will| will.is_legal() && will.recipient().is_some()) {
        return Err(format!("from {from}, wills: one of them is not a legal will"));
    }
    let incarnation = testament.incarnation;
    if !is_linked(state, from, incarnation) {
        return Err(format!(
            "from {from}, wills: they are of another incarnation of its node than the linked one"
        ));
    }
    feed(state, Input::TestamentReceived { from, testament });
    // The check follows `feed`. A revocation in between drops the wills that are stored then.
    if is_revoked(state, (from, incarnation)) {
        revoke(state, from, incarnation);
    }
    Ok(())
}

/// Returns whether this incarnation of a node is the linked one. With authentication, only the last
/// authenticated incarnation is. Otherwise the incarnation of GNCL's current link counts, or the one of the
/// last reported link. spec: WILL-6
fn is_linked(state: &State, node: NodeAddress, incarnation: Incarnation) -> bool {
    let links = state.ctx.ports.links();
    if let Some(proven) = links.as_ref().and_then(|links| links.authenticated_incarnation(node)) {
        return proven == incarnation;
    }
    let current = links.and_then(|links| links.incarnation(node));
    match lock(&state.wills).linked(node) {
        Some(reported) => incarnation == reported || current == Some(incarnation),
        // Wills from an incarnation before the current one were read before either link was reported. That
        // report is pending now.
        None => current.is_some_and(|current| incarnation <= current),
    }
}

/// Returns whether the certificate with which this incarnation was linked is on the deny list.
pub fn is_revoked(state: &State, life: NodeIncarnation) -> bool {
    state.ctx.ports.links().is_some_and(|links| links.is_revoked(life))
}

/// Drops the wills of a node that has a revoked link certificate. spec: WILL-5
pub fn revoke(state: &State, node: NodeAddress, incarnation: Incarnation) {
    feed(state, Input::Revoked { node, incarnation });
}

fn publish(state: &State, to: NodeAddress, testament: &Testament) {
    let payload = rmp_serde::to_vec_named(testament).expect("these types have no map with equal keys");
    let source = Tid::new(state.ctx.node, AppAddress::SYNC);
    let mut header = Header::new(Kind::SYNC_WILLS, source, Tid::new(to, AppAddress::SYNC));
    header.sequence = lock(&state.core).next_sequence();
    header.sent = Time::now();
    // A rejected list is sent again within 2 s, and when the link is up again.
    let _ = state.ctx.router.send(Message::new(header, payload.into()));
}

/// Sends the will to its local recipients. One node may leave any number of wills, repeatedly, so the log
/// entries are rate-limited.
fn execute(state: &State, (node, incarnation): (NodeAddress, Incarnation), will: &HeldWill) {
    let (Some(recipient), Some(class)) = (will.recipient(), will.class()) else { return };
    let destination = match &recipient {
        WillRecipient::Name(name) => {
            // If another node has the name, that node executes the will.
            let app = state.ctx.ports.applications().and_then(|applications| applications.resolve(name));
            let Some(app) = app else { return };
            Tid::new(state.ctx.node, app)
        }
        // `HERE` meant the lost node itself.
        WillRecipient::Tid(tid) if tid.node == state.ctx.node || tid.node == NodeAddress::ALL => *tid,
        WillRecipient::Tid(_) => return,
    };
    let mut header = Header::new(will.kind, Tid::new(node, will.app), destination);
    header.class = class;
    header.sent = Time::now();
    if let Some(suppressed) = state.ctx.log_quotas.wills.take(&node, header.sent) {
        sinew_runtime::log::warn!(source = %header.source, %destination, suppressed, "the last will of an application of a lost node");
    }
    let message = Message::new(header, will.payload());
    // The next incarnation of the node may be here already, and may use other names.
    let guard = state.security.access.get().and_then(|access| access.guard_for(node, incarnation));
    if let Err(why) = state.ctx.router.deliver_will(message, guard.as_ref())
        && let Some(suppressed) = state.ctx.log_quotas.wills_not_taken.take(&node, header.sent)
    {
        sinew_runtime::log::error!(source = %header.source, %destination, %why, suppressed, "a last will was rejected");
    }
}
