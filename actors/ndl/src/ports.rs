//! The port by which other layers query NDL.

use std::{net::SocketAddr, sync::TryLockError};

use sinew_model::ports::{ForeignNode, LostMember, Member, Members};
use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use super::{Core, State};

impl Members for State {
    fn paths(&self) -> Vec<SocketAddr> {
        lock(&self.core).paths().to_vec()
    }

    fn answers(&self, node: NodeAddress) -> bool {
        let core = lock(&self.core);
        core.has_member(node) && core.in_doubt().iter().all(|(other, _)| *other != node)
    }

    fn lost(&self) -> Vec<LostMember> {
        lost(&lock(&self.core))
    }

    fn present(&self) -> Vec<Member> {
        present(&lock(&self.core))
    }

    fn in_brief(&self) -> Option<(Vec<Member>, Vec<LostMember>)> {
        let core = match self.core.try_lock() {
            Ok(core) => core,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return None,
        };
        Some((present(&core), lost(&core)))
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

fn lost(core: &Core) -> Vec<LostMember> {
    let lost = core.lost_nodes().into_iter();
    lost.map(|(node, lost)| LostMember { node, incarnation: lost.incarnation, why: lost.why }).collect()
}

fn present(core: &Core) -> Vec<Member> {
    let members = core.members(Time::now()).into_iter();
    let member = |known: super::KnownNode| Member {
        node: known.node,
        incarnation: known.incarnation,
        name: known.name,
        gncl: known.gncl,
    };
    members.map(member).collect()
}
