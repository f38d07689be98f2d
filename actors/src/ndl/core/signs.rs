//! A member that does not answer, and of which GNCL hears, or that asks us: it lives, and either its NDL hangs or datagrams do not get through.
//!
//! Who asks says when. Where nodes have keys nobody else can say it, but what was recorded can be sent again, and what was held back can come when its
//! sender has died: so it counts only of who is connected, and only if it is new by his clock.

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Core, Host, Member, pace::Pace};

/// Times the answers that a member may miss: after so many it is told that its NDL is not heard. Where one datagram in
/// twenty is lost and the period is 30 ms, that is by chance twice a day; as many as may be missed would be twice a minute.
const UNHEARD: u32 = 2;

impl Member {
    /// Whether GNCL heard of it as lately as a member has to be heard of. What is read of a process that has ended is what was under way,
    /// and no sign. // spec: NDL-4.7
    pub(super) fn has_given_a_sign(&self, now: Time, pace: &Pace) -> bool {
        self.host != Some(Host::Refuses) && now.since(self.sign) < pace.sign_counts_for()
    }

    /// Whether GNCL heard of it after that, or it asked us: it lives, whatever it answers. // spec: NDL-5.3
    pub(super) fn has_given_a_sign_since(&self, then: Time) -> bool {
        self.host != Some(Host::Refuses) && self.sign > then
    }

    /// Whether its connection stands.
    pub(super) const fn is_linked(&self) -> bool {
        matches!(self.link_until, Time::MAX)
    }

    /// Whether what it sent at this time of its clock may have been sent so lately that it is a sign, by what is known of that clock. // spec: NDL-4.7
    fn may_have_sent_lately(&self, now: Time, sent: Time, pace: &Pace) -> bool {
        let times = self.clock.offset(now).and_then(|offset| offset.in_our_clock(now, sent));
        times.is_some_and(|(at, error)| now.since(at + error) < pace.sign_counts_for())
    }
}

impl Core {
    /// Members that are lost when the next missed answer is counted, or when a newcomer with their address shows that it lives, unless GNCL has
    /// heard of them: that is to be [said](super::Input::SignSeen) before it is.
    pub(crate) fn in_doubt(&self) -> Vec<(NodeAddress, Incarnation)> {
        let is_in_doubt = |member: &&Member| {
            self.contests.contains_key(&member.announcement.node)
                || member.missed + u32::from(member.is_awaited) >= self.paces[member.pace].missed_max
        };
        let members = self.members.values().filter(is_in_doubt);
        members.map(|member| (member.announcement.node, member.announcement.incarnation)).collect()
    }

    /// Whether what was sent in a member's name at this time of its clock says that it lives: where connections prove who is there, only of the
    /// life whose connection stands, and only while it is new. Of a clock that was never measured nobody knows that. // spec: NDL-4.7
    pub(super) fn is_a_sign(&self, now: Time, node: NodeAddress, sent: Time) -> bool {
        if !self.proves_peers() {
            return true;
        }
        let is_new = |member: &Member| member.may_have_sent_lately(now, sent, &self.paces[member.pace]);
        self.is_proven(node) && self.members.get(&node).is_some_and(is_new)
    }

    pub(super) fn sign_seen(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation, at: Time) {
        if let Some(member) = self.members.get_mut(&node)
            && member.announcement.incarnation == incarnation
        {
            member.sign = member.sign.max(at.min(now));
            member.heard = member.heard.max(member.sign);
        }
    }

    /// Whoever lives and does not answer: applications are told that its NDL does not get on. // spec: NDL-4.7
    pub(super) fn tell_who_does_not_answer(&mut self, at: usize) {
        let Pace { period, missed_max, .. } = self.paces[at];
        let is_unheard = |member: &&mut Member| member.pace == at && member.missed >= UNHEARD * missed_max;
        let members = self.members.values_mut().filter(is_unheard);
        let told = members.filter_map(|member| {
            let since = period * member.missed;
            member.troubles.does_not_answer(&member.announcement, since)
        });
        let told: Vec<_> = told.collect();
        told.iter().for_each(|event| self.publish(event));
    }

    pub(super) fn answers_again(&mut self, node: NodeAddress) {
        let Some(member) = self.members.get_mut(&node) else { return };
        if let Some(event) = member.troubles.answers(&member.announcement) {
            self.publish(&event);
        }
    }
}
