//! Faults in the core's behaviour, planted from outside: each must be found.

use sinew_model::{
    config::NodeConfig,
    facts::{LossReason, MembershipFact, NodeEvent},
};
use sinew_ndl::{
    core::{Core, Input, Output, Place},
    datagram::{Announcement, Body, Datagram, parse},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::network::{Flight, Kind};

/// A fault in the inputs, the outputs or the state of a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// An answer does not clear the missed answers before it.
    MissesNotCleared,
    /// A late timer is treated as a timely one.
    OwnStallCounted,
    /// A node that is always late itself never reports a loss.
    LossPostponedForever,
    /// An answer of a former incarnation replaces the present one.
    FormerIncarnationAccepted,
    /// A leave is ignored.
    LeaveIgnored,
    /// A node that stops sends no leave.
    LeaveNotSent,
    /// Answers to queries from before a loss count.
    LateAnswersAccepted,
    /// One missed answer fewer than allowed is a loss.
    LostTooEarly,
    /// One missed answer more than allowed is no loss.
    LostTooLate,
    /// The response of a silent node's host is ignored.
    ProbesIgnored,
    /// A host is probed at addresses that other hosts have, too, and the response of any of them counts.
    SharedAddressesProbed,
    /// The liveness hints of GNCL are ignored.
    HintsIgnored,
    /// A liveness hint of GNCL counts forever.
    HintsNeverExpire,
    /// Watch groups of the configuration are watched like all other nodes.
    WatchGroupsIgnored,
    /// A lost node is never queried again.
    LostNodesNotQueried,
    /// The reported bound of a clock is half of the true one.
    ClockBoundHalved,
    /// A loss by silence is not reported.
    LossNotReported,
    /// A member that does not answer at one of its addresses is silent.
    OneRouteDecides,
    /// Applications are not notified of a loss.
    LossEventDropped,
    /// Applications are notified of a loss twice.
    LossEventRepeated,
    /// A crash is reported to applications as a hang.
    CrashEventAsHang,
    /// A loss is reported to applications with a silence of zero.
    LossEventWithoutSilence,
    /// Applications are not notified of stalled applications.
    StallEventDropped,
    /// Applications are not notified of resumed applications.
    ResumeEventDropped,
}

impl Fault {
    pub(super) const ALL: [Self; 24] = [
        Self::MissesNotCleared,
        Self::OwnStallCounted,
        Self::LossPostponedForever,
        Self::FormerIncarnationAccepted,
        Self::LeaveIgnored,
        Self::LeaveNotSent,
        Self::LateAnswersAccepted,
        Self::LostTooEarly,
        Self::LostTooLate,
        Self::WatchGroupsIgnored,
        Self::ProbesIgnored,
        Self::SharedAddressesProbed,
        Self::HintsIgnored,
        Self::HintsNeverExpire,
        Self::LostNodesNotQueried,
        Self::ClockBoundHalved,
        Self::LossNotReported,
        Self::OneRouteDecides,
        Self::LossEventDropped,
        Self::LossEventRepeated,
        Self::CrashEventAsHang,
        Self::LossEventWithoutSilence,
        Self::StallEventDropped,
        Self::ResumeEventDropped,
    ];
}

/// The number of deliveries of an event.
enum Deliveries {
    Never,
    Once,
    Twice,
}

/// A core, and its fault.
pub(super) struct TestedCore {
    pub(super) core: Core,
    fault: Option<Fault>,
    /// An output to be repeated once.
    again: Option<Output>,
}

impl TestedCore {
    /// Creates the core of a node. `random` is its boot nonce and its secret.
    pub(super) fn new(
        mut config: NodeConfig,
        node: NodeAddress,
        incarnation: Incarnation,
        random: (u64, u128),
        fault: Option<Fault>,
    ) -> Self {
        let ndl = &mut config.ndl;
        let missed_max = std::iter::once(&mut ndl.missed_max)
            .chain(ndl.watch.iter_mut().map(|group| &mut group.missed_max));
        match fault {
            Some(Fault::LostTooEarly) => missed_max.for_each(|most| *most -= 1),
            Some(Fault::LostTooLate) => missed_max.for_each(|most| *most += 1),
            Some(Fault::WatchGroupsIgnored) => ndl.watch.clear(),
            Some(_) | None => {}
        }
        let (boot_nonce, secret) = random;
        let core = Core::new(&config, node, incarnation, boot_nonce, secret);
        Self { core, fault, again: None }
    }

    pub(super) fn receive(&mut self, now: Time, flight: &Flight) {
        match self.fault {
            Some(Fault::LeaveIgnored) if flight.kind == Kind::Leave => return,
            Some(Fault::FormerIncarnationAccepted) => self.accept_former_incarnation(now, flight),
            Some(Fault::LateAnswersAccepted) => self.accept_answer(now, flight),
            Some(_) | None => {}
        }
        // Only with this fault: the cost of a core is measured here, and must not grow with the needs of a fault.
        let before = (self.fault == Some(Fault::MissesNotCleared)).then(|| self.core.members(now));
        self.core.receive(now, place(flight), flight.cast, &flight.bytes);
        for member in before.into_iter().flatten() {
            self.core.set_missed(member.node, member.missed);
        }
    }

    pub(super) fn handle(&mut self, now: Time, input: Input) {
        let input = match (self.fault, input) {
            (Some(Fault::ProbesIgnored), Input::Probed { .. })
            | (Some(Fault::HintsIgnored), Input::HintReceived { .. }) => return,
            (Some(Fault::HintsNeverExpire), Input::HintReceived { node, incarnation, .. }) => {
                Input::HintReceived { node, incarnation, at: now }
            }
            (_, input) => input,
        };
        self.core.handle(now, input);
    }

    /// Removes the present incarnation of a node if this is an answer of an earlier one.
    fn accept_former_incarnation(&mut self, now: Time, flight: &Flight) {
        let Ok(Datagram { correlation, body: Body::Answer(answer), .. }) =
            parse(self.core.announcement().node, &flight.bytes)
        else {
            return;
        };
        let Announcement { node, incarnation, .. } = answer.announcement;
        let members = self.core.members(now);
        let is_former = members.iter().any(|member| member.node == node && incarnation < member.incarnation);
        if is_former && self.core.accepts_answer(place(flight), correlation) {
            self.core.forget_incarnation(now, node);
            self.accept_answer(now, flight);
        }
    }

    fn accept_answer(&mut self, now: Time, flight: &Flight) {
        if let Kind::Answer(correlation) = flight.kind {
            self.core.accept_answer(now, place(flight), correlation);
        }
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        while self.fault == Some(Fault::OwnStallCounted)
            && let Some(due) = self.core.next_wake().filter(|due| *due < now)
        {
            self.core.handle(due, Input::TimePassed);
        }
        if self.fault == Some(Fault::LossPostponedForever) {
            self.core.forget_late_timers();
        }
        if self.fault == Some(Fault::OneRouteDecides) {
            for member in self.core.members(now) {
                let missed = member.routes.iter().map(|route| route.missed).max();
                self.core.set_missed(member.node, member.missed.max(missed.unwrap_or(0)));
            }
        }
        self.core.handle(now, Input::TimePassed);
    }

    pub(super) fn poll(&mut self) -> Option<Output> {
        if let Some(output) = self.again.take() {
            return Some(output);
        }
        loop {
            let mut output = self.core.poll()?;
            if let Output::Event { event, .. } = &mut output {
                match self.deliveries(event) {
                    Deliveries::Once => {}
                    Deliveries::Twice => self.again = Some(output.clone()),
                    Deliveries::Never => continue,
                }
            }
            match (self.fault, &mut output) {
                (Some(Fault::LeaveNotSent), Output::SendLeave { .. }) => {}
                (Some(Fault::ClockBoundHalved), Output::ClockMeasured { offset, .. }) => {
                    offset.bound /= 2;
                    return Some(output);
                }
                (Some(Fault::LossNotReported), Output::Fact(fact)) if is_silence(fact) => {}
                (Some(Fault::LostNodesNotQueried), Output::Fact(fact)) if is_silence(fact) => {
                    self.core.forget_departed_addresses();
                    return Some(output);
                }
                _ => return Some(output),
            }
        }
    }

    /// Applies the fault to an event for applications.
    fn deliveries(&self, event: &mut NodeEvent) -> Deliveries {
        match (self.fault, event) {
            (Some(Fault::LossEventDropped), NodeEvent::NodeLost { .. })
            | (Some(Fault::StallEventDropped), NodeEvent::AppStalled { .. })
            | (Some(Fault::ResumeEventDropped), NodeEvent::AppResumed { .. }) => Deliveries::Never,
            (Some(Fault::LossEventRepeated), NodeEvent::NodeLost { .. }) => Deliveries::Twice,
            (Some(Fault::CrashEventAsHang), NodeEvent::NodeLost { why, .. }) => {
                if matches!(why, LossReason::Crashed) {
                    *why = LossReason::Hung;
                }
                Deliveries::Once
            }
            (Some(Fault::LossEventWithoutSilence), NodeEvent::NodeLost { silent_us, .. }) => {
                *silent_us = 0;
                Deliveries::Once
            }
            _ => Deliveries::Once,
        }
    }
}

const fn place(flight: &Flight) -> Place {
    Place { there: flight.from, here: flight.to }
}

const fn is_silence(fact: &MembershipFact) -> bool {
    use LossReason::{Crashed, Hung, LinkDown};
    matches!(fact, MembershipFact::NodeLost { why: Crashed | Hung | LinkDown, .. })
}
