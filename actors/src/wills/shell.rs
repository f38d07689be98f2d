//! Carries the core's orders out, on whatever thread has news for it. Not for who holds a lock of the node's.

use sinew_runtime::{
    app::Heir,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message, decode},
};

use super::{
    core::{Input, Output},
    words::{HeldWill, Testament},
};
use crate::{
    gncl::{self, LinkFact},
    ndl::{LossReason, MembershipFact},
    stores::{Stores, lock},
    sync,
};

impl Input {
    /// What a change of who is there is to wills; `None`: nothing.
    pub(crate) const fn of_membership(fact: &MembershipFact) -> Option<Self> {
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
                Some(Self::WasNobody { node, incarnation })
            }
        }
    }

    /// What a link's change is to wills; `None`: nothing.
    pub(crate) fn of_link(fact: &LinkFact) -> Option<Self> {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => Some(Self::LinkUp { node, incarnation }),
            LinkFact::LinkBroken { node, incarnation } => Some(Self::LinkBroken { node, incarnation }),
            // A node says goodbye on a link behind the wills that it has executed, also when it gives up.
            LinkFact::PeerLeft { node, incarnation, gave_up: _ } => {
                Some(Self::NodeLeft { node, incarnation })
            }
            LinkFact::DialRefused { .. } => None,
        }
    }
}

/// Tells the core what has happened and carries out what follows.
pub(crate) fn feed(stores: &Stores, input: Input) {
    let is_earlier = {
        let mut core = lock(&stores.wills);
        let before = core.next_wake();
        core.handle(Time::now(), input);
        core.next_wake().is_some_and(|wake| before.is_none_or(|before| wake < before))
    };
    loop {
        let Some(output) = lock(&stores.wills).poll() else { break };
        match output {
            Output::Tell { to, testament, left_out } => {
                if left_out > 0 {
                    let detail = format!(
                        "{left_out} last wills of this node's applications are not held by other nodes: there are more than 256, or \
                         they are longer than `node.payload_max` together; raise it, or write shorter ones"
                    );
                    stores.refusals.count(Time::now(), "wills", &detail);
                }
                tell(stores, to, &testament);
            }
            Output::Execute { node, life, will } => execute(stores, (node, life), &will),
        }
    }
    if is_earlier && stores.posts.sync.post(sync::Event::Monitors).is_err() {
        crate::log::error!("the sync manager's post is full; wills are told late: does it hang?");
    }
}

/// When the sync manager has to say that time has passed.
pub(crate) fn next_wake(stores: &Stores) -> Option<Time> {
    lock(&stores.wills).next_wake()
}

/// Takes the wills of another node.
///
/// # Errors
/// What is wrong with them, in words.
pub(crate) fn receive(stores: &Stores, from: NodeAddress, message: &Message) -> Result<(), String> {
    let testament: Testament =
        decode(&message.payload).map_err(|error| format!("from {from}, wills: {error}"))?;
    if !testament.wills.iter().all(|will| will.is_legal() && will.heir().is_some()) {
        return Err(format!("from {from}, wills: one of them is not what a will may be"));
    }
    let incarnation = testament.incarnation;
    if !is_linked(stores, from, incarnation) {
        return Err(format!(
            "from {from}, wills: they are of another life of its node than the one that is linked"
        ));
    }
    feed(stores, Input::Told { from, testament });
    // Asked behind it: who has the certificate put on the list meanwhile drops what is there then.
    if gncl::is_revoked(stores, from, incarnation) {
        revoke(stores, from, incarnation);
    }
    Ok(())
}

/// Whether this life of a node is the one that is linked: as GNCL has it now or, of what came before that, as it was told behind what came
/// before it. Where nodes prove who they are, only the one that did so last. spec: WILL-6
fn is_linked(stores: &Stores, node: NodeAddress, life: Incarnation) -> bool {
    if let Some(proven) = gncl::proven_life(stores, node) {
        return proven == life;
    }
    let now = stores.gncl.peer(node).map(|peer| peer.incarnation);
    match lock(&stores.wills).linked(node) {
        Some(told) => life == told || now == Some(life),
        // What came of a life before the present one was read before anybody was told of either; that is told now.
        None => now.is_some_and(|now| life <= now),
    }
}

/// The certificate with which this life of a node was linked is revoked. spec: WILL-5
pub(crate) fn revoke(stores: &Stores, node: NodeAddress, incarnation: Incarnation) {
    feed(stores, Input::Revoked { node, incarnation });
}

fn tell(stores: &Stores, to: NodeAddress, testament: &Testament) {
    let payload = rmp_serde::to_vec_named(testament).expect("these types have no map with equal keys");
    let source = Tid::new(stores.node, AppAddress::SYNC);
    let mut header = Header::new(Kind::SYNC_WILLS, source, Tid::new(to, AppAddress::SYNC));
    header.sequence = lock(&stores.sync).next_sequence();
    header.sent = Time::now();
    // Not taken: it is told again within 2 s, and when the link is back.
    let _ = stores.router.send(Message::new(header, payload.into()));
}

/// Hands the will to those of our own applications that it is for. One node may leave as many as it likes, again and again: each line in the
/// log is one of so many.
fn execute(stores: &Stores, (node, life): (NodeAddress, Incarnation), will: &HeldWill) {
    let (Some(heir), Some(class)) = (will.heir(), will.class()) else { return };
    let destination = match &heir {
        Heir::Name(name) => {
            // One of another name's node is that node's business.
            let Some(app) = lock(&stores.registry).resolve(name) else { return };
            Tid::new(stores.node, app)
        }
        // HERE was the lost node itself.
        Heir::Tid(tid) if tid.node == stores.node || tid.node == NodeAddress::ALL => *tid,
        Heir::Tid(_) => return,
    };
    let mut header = Header::new(will.kind, Tid::new(node, will.app), destination);
    header.class = class;
    header.sent = Time::now();
    if let Some(suppressed) = stores.log_quotas.wills.take(&node, header.sent) {
        crate::log::warn!(source = %header.source, %destination, suppressed, "the last will of an application of a lost node");
    }
    let message = Message::new(header, will.payload());
    // The next life of the node may be here already, and call others so.
    let delivered = match stores.access.get().and_then(|access| access.of_life(node, life)) {
        Some(guard) => stores.router.deliver_judged_by(message, &guard),
        None => stores.router.deliver(message),
    };
    if let Err(why) = delivered
        && let Some(suppressed) = stores.log_quotas.wills_not_taken.take(&node, header.sent)
    {
        crate::log::error!(source = %header.source, %destination, %why, suppressed, "a last will was not taken");
    }
}
