//! Liveness of a member that does not answer, but that GNCL receives from or that queries this node. Either
//! its NDL hangs or datagrams are lost.
//!
//! A query states its send time. Where nodes have keys, no other node can make it. But a recorded query can
//! be replayed, and a delayed one can arrive after its sender has died. So a query counts only from a
//! connected node, and only if it is recent by the sender's clock.

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use sinew_model::facts::NodeEvent;

use super::{
    Host, Member, Source,
    authenticated::Authenticated,
    members::Members,
    paces::{Pace, Paces},
};

/// Multiple of `missed_max` after which a member's NDL is reported as silent. At one lost datagram in
/// twenty and a period of 30 ms, that happens by chance twice a day. A multiple of one would do so twice a
/// minute.
const UNHEARD: u32 = 2;

impl Member {
    /// Returns whether GNCL received from the member within the required time. Data of a process that has
    /// ended was still in flight, and is no sign of life. // spec: NDL-4.7
    pub(super) fn is_hinted_alive(&self, now: Time, pace: &Pace) -> bool {
        self.host != Some(Host::Refuses) && now.since(self.last_hint) < pace.hint_valid_for()
    }

    /// Returns whether GNCL received from the member after `then`, or the member queried this node. In both
    /// cases it is alive.
    // spec: NDL-5.3
    pub(super) fn is_hinted_alive_since(&self, then: Time) -> bool {
        self.host != Some(Host::Refuses) && self.last_hint > then
    }

    /// Returns whether the member's connection is established.
    pub(super) const fn is_linked(&self) -> bool {
        matches!(self.link_until, Time::MAX)
    }

    /// Records that GNCL received from the member at `at`.
    pub(super) fn mark_alive(&mut self, now: Time, at: Time) {
        self.last_hint = self.last_hint.max(at.min(now));
        self.last_seen = self.last_seen.max(self.last_hint);
    }

    /// Returns whether a datagram may be recent enough as a sign of life. `sent` is its send time in the member's
    /// clock, which must have a known offset. // spec: NDL-4.7
    fn may_have_sent_recently(&self, now: Time, sent: Time, pace: &Pace) -> bool {
        let times = self.clock.offset(now).and_then(|offset| offset.in_our_clock(now, sent));
        times.is_some_and(|(at, error)| now.since(at + error) < pace.hint_valid_for())
    }
}

impl Members {
    /// Returns the members that are lost at the next missed answer, or that `is_contested` names. They are not
    /// lost if GNCL received from them.
    pub(super) fn in_doubt(
        &self,
        paces: &Paces,
        is_contested: impl Fn(NodeAddress) -> bool,
    ) -> Vec<(NodeAddress, Incarnation)> {
        let is_in_doubt = |member: &&Member| {
            is_contested(member.announcement.node)
                || member.missed + u32::from(member.is_awaited) >= paces.of(member).missed_max
        };
        let members = self.values().filter(is_in_doubt);
        members.map(|member| (member.announcement.node, member.announcement.incarnation)).collect()
    }

    /// Records a datagram in a member's name, with this send time in its clock, if it is a sign of life.
    ///
    /// Where connections authenticate nodes, it is one only for the connected incarnation, and only while it
    /// is recent. For a clock that was never measured this is unknown. // spec: NDL-4.7
    pub(super) fn received(
        &mut self,
        now: Time,
        (node, sent): (NodeAddress, Time),
        source: Source,
        (authenticated, paces): (&Authenticated, &Paces),
    ) {
        let is_authenticated = !authenticated.is_required() || authenticated.has(self, node);
        let Some(member) = self.get_mut(&node).filter(|_| is_authenticated) else { return };
        if authenticated.is_required() && !member.may_have_sent_recently(now, sent, paces.of(member)) {
            return;
        }
        member.last_seen = now;
        if source == Source::Query {
            // A member that queries this node is alive, even if this node's queries fail. It queries as long
            // as it receives answers. spec: NDL-4.7
            member.last_hint = now;
        }
    }

    /// Returns a stall event for the NDL of each member that is alive but does not answer. spec: NDL-4.7
    pub(super) fn unheard(&mut self, at: usize, pace: &Pace) -> Vec<NodeEvent> {
        let unheard = self.at_pace(at).filter(|(_, member)| member.missed >= UNHEARD * pace.missed_max);
        let events = unheard.filter_map(|(_, member)| {
            let since = pace.period * member.missed;
            member.troubles.does_not_answer(&member.announcement, since)
        });
        events.collect()
    }
}
