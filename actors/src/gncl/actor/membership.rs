//! Who is there and who is lost, as NDL tells it.

use actix::{Context, StreamHandler};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    super::{Event, core::Input},
    Gncl,
};
use crate::{
    ndl::{KnownNode, LossReason, LostNode, MembershipFact},
    stores::lock,
};

impl Gncl {
    /// What a former instance of this layer left behind, and what NDL has told so far: it tells each change once, and that instance may
    /// have had the last one in its hand. spec: GNCL-7
    pub(super) fn catch_up(&mut self, ctx: &mut Context<Self>) {
        for peer in self.stores.gncl.peers() {
            self.input(Input::Restored { node: peer.node, incarnation: peer.incarnation }, ctx);
        }
        let (lost, members) = {
            let ndl = lock(&self.stores.ndl);
            (ndl.lost_nodes(), ndl.members(Time::now()))
        };
        for (node, LostNode { incarnation, why, .. }) in lost {
            match why {
                // One that leaves may still have something to say, and of a process that was none nothing is known.
                LossReason::Left | LossReason::GaveUp(_) | LossReason::Duplicate => {}
                LossReason::Crashed | LossReason::Hung | LossReason::LinkDown | LossReason::Restarted => {
                    self.input(lost_as(&why, node, incarnation), ctx);
                }
            }
        }
        self.disprove_the_denied(ctx);
        for KnownNode { node, incarnation, gncl: addresses, .. } in members {
            self.takes_back(node, incarnation, ctx);
            self.input(Input::NodeFound { node, incarnation, addresses }, ctx);
        }
    }

    /// A life that NDL has found has not left. Was it given up for that, what there is with it ends first, as nothing passes there any more.
    /// spec: GNCL-10
    fn takes_back(&mut self, node: NodeAddress, incarnation: Incarnation, ctx: &mut Context<Self>) {
        if self.stores.gncl.has_given_up(node, incarnation) {
            self.input(Input::NodeDisowned { node, incarnation }, ctx);
        }
    }
}

const fn lost_as(why: &LossReason, node: NodeAddress, incarnation: Incarnation) -> Input {
    match why {
        LossReason::Left | LossReason::GaveUp(_) => Input::NodeLeaves { node, incarnation },
        LossReason::Duplicate => Input::NodeDisowned { node, incarnation },
        LossReason::Crashed | LossReason::Hung | LossReason::LinkDown | LossReason::Restarted => {
            Input::NodeLost { node, incarnation }
        }
    }
}

impl StreamHandler<Event> for Gncl {
    fn handle(&mut self, event: Event, ctx: &mut Context<Self>) {
        let input = match event {
            Event::Membership(MembershipFact::NodeFound { node, incarnation, gncl }) => {
                self.takes_back(node, incarnation, ctx);
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            // It is dialled there from the next time on; a link that stands is left alone.
            Event::Moved { node, incarnation, gncl } => {
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            Event::Membership(MembershipFact::NodeLost { node, incarnation, why }) => {
                lost_as(&why, node, incarnation)
            }
            Event::Forgotten { node, incarnation } => Input::NodeDisowned { node, incarnation },
            Event::DenyListChanged => return self.end_the_denied(ctx),
        };
        // Of a node that is not known the core takes it that a former instance may have linked it.
        let is_as_linked = matches!(input, Input::NodeLost { node, .. } if !self.core.knows(node));
        self.input(input, ctx);
        if is_as_linked {
            self.disprove_the_denied(ctx);
        }
    }
}
