//! Where there is no timerfd: the drainer is woken at once.

use std::task::Context;

/// Who would wake the drainer of a connection later.
#[derive(Debug, Default)]
pub(super) struct Rouser;

impl Rouser {
    /// Returns whether it will be woken.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn rouse_later(&mut self) -> bool {
        false
    }

    /// The drainer is awake.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn poll(&mut self, _: &mut Context<'_>) {}
}
