//! The groups of one client: the check whether it may join one, and the limit on membership orders per turn.

use std::{cell::Cell, ops::ControlFlow};

use sinew_protocol::payload;
use sinew_runtime::{
    lock,
    outcome::{Outcome, Rejection},
    tid::AppAddress,
    time::Time,
};
use sinew_security::access::JoinGroupError;

use super::{
    super::{
        core::{Owner, Registry},
        registrar,
        session::{Order, Session},
    },
    Client,
    end::ConnectionEnd,
};
use crate::State;

/// Membership orders of one client before other tasks of the thread run. Each order copies part of a table, and makes
/// the sync manager check all groups.
const ORDERS_PER_TURN: usize = 4;
/// Number of memberships of all applications of the node, in any process, from which on clients get no further one.
const MEMBERSHIPS_MAX: usize = 16_384;

/// Membership orders since other tasks ran.
#[derive(Debug, Default)]
pub(super) struct Orders(Cell<usize>);

impl Orders {
    pub(super) fn count(&self) {
        self.0.set(self.0.get() + 1);
    }

    /// Yields to other tasks after [`ORDERS_PER_TURN`] orders.
    // spec: LNCL-16
    pub(super) async fn wait_for_turn(&self) {
        if self.0.get() >= ORDERS_PER_TURN {
            self.0.set(0);
            tokio::task::yield_now().await;
        }
    }
}

impl Client {
    /// Executes an order of the client. Returns the end of the connection if the order ends it. A group that the client
    /// may not join is removed from its session, too.
    pub(super) fn execute_session(&self, session: &mut Session, order: Order) -> ControlFlow<ConnectionEnd> {
        if let Order::SetMember { group, member: true, confirm } = order
            && let Err(why) = self.may_join(group)
        {
            session.remove_group(group);
            self.orders.count();
            self.refuse_to_join(&why, confirm);
            return ControlFlow::Continue(());
        }
        self.execute(order)
    }

    /// Makes the client a member of the group, which it is allowed to be, or removes it.
    pub(super) fn set_member(&self, group: AppAddress, member: bool, confirm: Option<u64>) {
        self.orders.count();
        let app = self.tid.app;
        let set = |state: &State, registry: &Registry| {
            let leaves = !member && state.ctx.router.is_member(group, app);
            registrar::set_registered_member(state, registry, app, group, member);
            if leaves && let Some(access) = state.security.access.get() {
                access.leave(app);
            }
            Outcome::Delivered
        };
        let outcome = self.while_registered(set);
        if let Some(correlation) = confirm {
            let outcome = outcome.unwrap_or(Outcome::Rejected(Rejection::NoSuchApplication));
            self.send_outcome(payload::lncl_of(self.tid.node), correlation, outcome);
        }
    }

    /// Runs `act` if the client still has its address, under the registry's lock. A later incarnation of LNCL may have
    /// removed the registration, since this one hung; then the effects of `act` would never be undone.
    pub(super) fn while_registered<T>(&self, act: impl FnOnce(&State, &Registry) -> T) -> Option<T> {
        let state = &self.server.state;
        let registry = lock(&state.registry);
        let owner = registry.owner_of(self.tid.app);
        let is_registered = match &self.command {
            Some(port) => owner == Some(Owner::Command) && port.is_held_by(self.peer.id),
            None => owner == Some(self.peer.owner()),
        };
        is_registered.then(|| act(state, &registry))
    }

    /// Checks whether the client may join the group, and counts the join. An existing membership stays.
    fn may_join(&self, group: AppAddress) -> Result<(), JoinGroupError> {
        self.while_registered(|state, _| self.may_join_by(state, group)).unwrap_or(Err(JoinGroupError::Gone))
    }

    fn may_join_by(&self, state: &State, group: AppAddress) -> Result<(), JoinGroupError> {
        if state.ctx.router.is_member(group, self.tid.app) {
            return Ok(());
        }
        if state.ctx.router.memberships() >= MEMBERSHIPS_MAX {
            return Err(JoinGroupError::NodeFull { limit: MEMBERSHIPS_MAX });
        }
        let Some(access) = state.security.access.get() else { return Ok(()) };
        let own = rustix::process::geteuid().as_raw();
        access.join(own, (self.peer.applicant, self.tid.app), group)
    }

    /// Logs it like a refused registration, and sends the client the outcome, if it requested one.
    fn refuse_to_join(&self, refusal: &JoinGroupError, confirm: Option<u64>) {
        let detail = format!("of {} ({}): {refusal}", self.name, self.tid);
        self.server.refusals.count(Time::now(), "membership", &detail);
        if let Some(correlation) = confirm {
            self.send_outcome(payload::lncl_of(self.tid.node), correlation, Outcome::Rejected(refusal.why()));
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[test]
    fn other_tasks_run_after_a_few_orders() {
        let orders = Orders::default();
        for _ in 0..2 {
            for number in 1..=ORDERS_PER_TURN {
                assert_eq!(orders.wait_for_turn().now_or_never(), Some(()), "before order {number}");
                orders.count();
            }
            assert_eq!(orders.wait_for_turn().now_or_never(), None, "after {ORDERS_PER_TURN}");
        }
    }
}
