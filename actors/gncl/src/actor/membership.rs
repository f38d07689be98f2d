//! Membership events of NDL: nodes found and nodes lost.

use actix::{Context, StreamHandler};
use sinew_model::{
    facts::{LossReason, MembershipFact},
    ports::{LostMember, Member},
};
use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::{
    super::{Event, core::Input},
    Gncl,
};

impl Gncl {
    /// Restores the peers of a former instance of this layer, and the present membership of NDL. NDL reports
    /// each change once, and the former instance may have received the last one without processing it. spec:
    /// GNCL-7
    pub(super) fn catch_up(&mut self, ctx: &mut Context<Self>) {
        for peer in self.state.store.peers() {
            self.input(Input::Restored { node: peer.node, incarnation: peer.incarnation }, ctx);
        }
        let (lost, present) = match self.state.ctx.ports.members() {
            Some(members) => (members.lost(), members.present()),
            None => (Vec::new(), Vec::new()),
        };
        for LostMember { node, incarnation, why } in lost {
            match why {
                // A leaving node may still send messages, and nothing is known of a process that was no member.
                LossReason::Left | LossReason::GaveUp(_) | LossReason::Duplicate => {}
                LossReason::Crashed | LossReason::Hung | LossReason::LinkDown | LossReason::Restarted => {
                    self.input(Input::of_loss(&why, node, incarnation), ctx);
                }
            }
        }
        self.revoke_denied(ctx);
        for Member { node, incarnation, gncl: addresses, .. } in present {
            self.readmit(node, incarnation, ctx);
            self.input(Input::NodeFound { node, incarnation, addresses }, ctx);
        }
    }

    /// Accepts an incarnation that NDL has found again, and that therefore has not left. If it was given up
    /// as having left, its state is removed first, because that state passes no messages any more. spec:
    /// GNCL-10
    fn readmit(&mut self, node: NodeAddress, incarnation: Incarnation, ctx: &mut Context<Self>) {
        if self.state.store.take_given_up(node, incarnation) {
            self.input(Input::NodeDisowned { node, incarnation }, ctx);
        }
    }
}

impl StreamHandler<Event> for Gncl {
    fn handle(&mut self, event: Event, ctx: &mut Context<Self>) {
        let input = match event {
            Event::Membership(MembershipFact::NodeFound { node, incarnation, gncl }) => {
                self.readmit(node, incarnation, ctx);
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            // The next dial uses the new address; an established link is not changed.
            Event::Moved { node, incarnation, gncl } => {
                Input::NodeFound { node, incarnation, addresses: gncl }
            }
            Event::Membership(MembershipFact::NodeLost { node, incarnation, why }) => {
                Input::of_loss(&why, node, incarnation)
            }
            Event::Forgotten { node, incarnation } => Input::NodeDisowned { node, incarnation },
            Event::DenyListChanged => return self.refuse_denied(ctx),
        };
        // The core assumes that a former instance may have linked an unknown node.
        let is_as_linked = matches!(input, Input::NodeLost { node, .. } if !self.core.is_known(node));
        self.input(input, ctx);
        if is_as_linked {
            self.revoke_denied(ctx);
        }
    }
}
