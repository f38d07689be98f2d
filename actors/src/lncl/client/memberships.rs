//! The groups of one client: whether it may join one, and how many of its orders about them are carried out in one turn.

use std::{cell::Cell, ops::ControlFlow};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::AppAddress,
    time::Time,
};

use super::{
    super::{
        core::Registry,
        payload, registrar,
        session::{Order, Session},
    },
    Client,
    end::End,
};
use crate::{
    access::JoinRefusal,
    stores::{Stores, lock},
};

/// Orders about memberships that are carried out for one client before other tasks of the thread have their turn: each copies part of a table,
/// and has the sync manager look at all groups.
const ORDERS_A_TURN: usize = 4;
/// Memberships of all applications of the node, in whatever process, from which on no client gets a further one.
const MEMBERSHIPS_MAX: usize = 16_384;

/// Orders about memberships since others had their turn.
#[derive(Debug, Default)]
pub(super) struct Orders(Cell<usize>);

impl Orders {
    pub(super) fn count(&self) {
        self.0.set(self.0.get() + 1);
    }

    /// Lets others have their turn, when enough were carried out.
    // spec: LNCL-16
    pub(super) async fn may_come(&self) {
        if self.0.get() >= ORDERS_A_TURN {
            self.0.set(0);
            tokio::task::yield_now().await;
        }
    }
}

impl Client {
    /// Carries out what the client has sent; the end of the connection, if that is what it asks for. A group that it may not join is none of
    /// its session's either.
    pub(super) fn obey_session(&self, session: &mut Session, order: Order) -> ControlFlow<End> {
        if let Order::SetMember { group, member: true, confirm } = order
            && let Err(why) = self.may_join(group)
        {
            session.has_not_joined(group);
            self.orders.count();
            self.refuse_to_join(&why, confirm);
            return ControlFlow::Continue(());
        }
        self.obey(order)
    }

    /// Makes it a member of the group, which it may be, or no longer one.
    pub(super) fn set_member(&self, group: AppAddress, member: bool, confirm: Option<u64>) {
        self.orders.count();
        let app = self.tid.app;
        let set = |stores: &Stores, registry: &Registry| {
            let leaves = !member && stores.router.is_member(group, app);
            registrar::set_registered_member(stores, registry, app, group, member);
            if leaves && let Some(access) = stores.access.get() {
                access.leave(app);
            }
            Outcome::Delivered
        };
        let outcome = self.while_registered(set);
        if let Some(correlation) = confirm {
            let outcome = outcome.unwrap_or(Outcome::Rejected(Rejection::NoSuchApplication));
            self.tell(payload::lncl_of(self.tid.node), correlation, outcome);
        }
    }

    /// Does this while it has its address, if it still has: a later life of LNCL takes it back from this one, which hung, and nobody would
    /// take back what comes of it afterwards. The registry's lock is held meanwhile.
    fn while_registered<T>(&self, act: impl FnOnce(&Stores, &Registry) -> T) -> Option<T> {
        let stores = &self.server.stores;
        let registry = lock(&stores.registry);
        (registry.owner_of(self.tid.app) == Some(self.peer.owner())).then(|| act(stores, &registry))
    }

    /// Whether it may be a member from now on, which is counted. What it is a member of already it stays.
    fn may_join(&self, group: AppAddress) -> Result<(), JoinRefusal> {
        self.while_registered(|stores, _| self.may_join_by(stores, group)).unwrap_or(Err(JoinRefusal::Gone))
    }

    fn may_join_by(&self, stores: &Stores, group: AppAddress) -> Result<(), JoinRefusal> {
        if stores.router.is_member(group, self.tid.app) {
            return Ok(());
        }
        if stores.router.memberships() >= MEMBERSHIPS_MAX {
            return Err(JoinRefusal::NodeFull { limit: MEMBERSHIPS_MAX });
        }
        let Some(access) = stores.access.get() else { return Ok(()) };
        let own = rustix::process::geteuid().as_raw();
        access.join(own, (self.peer.who, self.tid.app), group)
    }

    /// In words in the log, as a registration that is refused; to the client by the outcome that it may have asked for.
    fn refuse_to_join(&self, refusal: &JoinRefusal, confirm: Option<u64>) {
        let detail = format!("of {} ({}): {refusal}", self.name, self.tid);
        self.server.refusals.count(Time::now(), "membership", &detail);
        if let Some(correlation) = confirm {
            self.tell(payload::lncl_of(self.tid.node), correlation, Outcome::Rejected(refusal.why()));
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[test]
    fn after_a_few_orders_others_have_their_turn() {
        let orders = Orders::default();
        for _ in 0..2 {
            for number in 1..=ORDERS_A_TURN {
                assert_eq!(orders.may_come().now_or_never(), Some(()), "before order {number}");
                orders.count();
            }
            assert_eq!(orders.may_come().now_or_never(), None, "after {ORDERS_A_TURN}");
        }
    }
}
