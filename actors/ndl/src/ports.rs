//! The port by which other layers query NDL.

use std::net::SocketAddr;

use sinew_model::ports::{ForeignNode, LostMember, Member, Members};
use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use super::State;

impl Members for State {
    fn paths(&self) -> Vec<SocketAddr> {
        lock(&self.core).paths().to_vec()
    }

    fn answers(&self, node: NodeAddress) -> bool {
        let core = lock(&self.core);
        core.has_member(node) && core.in_doubt().iter().all(|(other, _)| *other != node)
    }

    fn lost(&self) -> Vec<LostMember> {
        let lost = lock(&self.core).lost_nodes().into_iter();
        lost.map(|(node, lost)| LostMember { node, incarnation: lost.incarnation, why: lost.why }).collect()
    }

    fn present(&self) -> Vec<Member> {
        let members = lock(&self.core).members(Time::now()).into_iter();
        let member = |known: super::KnownNode| Member {
            node: known.node,
            incarnation: known.incarnation,
            name: known.name,
            gncl: known.gncl,
        };
        members.map(member).collect()
    }

    fn strangers_if_alone(&self) -> Option<Vec<ForeignNode>> {
        let core = lock(&self.core);
        if core.has_members() {
            return None;
        }
        let neighbours = core.neighbours().into_iter();
        let foreign =
            neighbours.map(|(at, other)| ForeignNode { at, name: other.name, project: other.project });
        Some(foreign.collect())
    }
}
