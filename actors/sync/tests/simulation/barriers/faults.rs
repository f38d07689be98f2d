//! Planted faults in the frames, the state and the inputs of nodes: each must be found.

use sinew_model::barrier::BarrierStatus;

use super::*;
use sinew_sync::list::List;

/// A loss is reported earlier by this time, which is no more than the tolerance of a timer.
const TOO_EARLY: Duration = Duration::from_millis(10);

/// A fault in the frames between nodes, in the answers to applications, or in the state of nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fault {
    /// A waiting application is published behind the newest generation that the receiver knows.
    GenerationsConfused,
    /// The members that passed are not published.
    MembersLeftOut,
    /// The members that passed a generation earlier than the last are not published.
    EarlierLeftOut,
    /// A node publishes each application that ever waited as waiting.
    DeparturesHidden,
    /// Of two nodes with one address the younger is accepted, even when the elder is linked.
    YoungerAccepted,
    /// Earlier visits to a barrier are forgotten, so another barrier can displace it.
    VisitsForgotten,
    /// The successor of a failed actor handles an event again that its predecessor has handled.
    HandledAgain,
    /// No wait has a deadline.
    DeadlineForgotten,
    /// A wait ends after half of its time.
    TimedOutEarly,
    /// An application that asked to be notified of a loss is not.
    LossNotReported,
    /// An application that waits for a lost party's return is notified of the loss.
    LossReportedUnasked,
    /// A loss is reported while the frame about an opening may still be in flight.
    LossReportedEarly,
    /// A node with a broken link is reported as lost.
    WrongReason,
    /// The reason that was given first for a name is given ever after.
    ReasonKept,
    /// An arrived application is reported missing.
    ArrivedNamed,
    /// A missing application is reported missing for as long as the longest wait.
    AbsenceOverstated,
    /// An input from another node is handled at the clock reading of that node.
    ClocksConfused,
    /// The applications that have reached a phase are not published.
    PhasesLeftOut,
    /// All applications are published as having reached each phase.
    PhasesMadeUp,
}

impl Fault {
    pub(super) const ALL: [Self; 19] = [
        Self::GenerationsConfused,
        Self::MembersLeftOut,
        Self::EarlierLeftOut,
        Self::DeparturesHidden,
        Self::YoungerAccepted,
        Self::VisitsForgotten,
        Self::HandledAgain,
        Self::DeadlineForgotten,
        Self::TimedOutEarly,
        Self::LossNotReported,
        Self::LossReportedUnasked,
        Self::LossReportedEarly,
        Self::WrongReason,
        Self::ReasonKept,
        Self::ArrivedNamed,
        Self::AbsenceOverstated,
        Self::ClocksConfused,
        Self::PhasesLeftOut,
        Self::PhasesMadeUp,
    ];
}

impl World {
    /// Returns the wait limit in milliseconds and the loss policy, as the node receives them.
    pub(super) fn received_limits(&self, within_ms: u32, on_loss: OnPartyLoss) -> (u32, OnPartyLoss) {
        match self.fault {
            Some(Fault::DeadlineForgotten) => (FOR_EVER_MS, on_loss),
            Some(Fault::TimedOutEarly) => (within_ms / 2, on_loss),
            Some(Fault::LossNotReported) => (within_ms, OnPartyLoss::Wait),
            Some(Fault::LossReportedUnasked) => (within_ms, OnPartyLoss::Fail),
            Some(_) | None => (within_ms, on_loss),
        }
    }

    /// Returns the clock reading at which a process handles an input.
    pub(super) fn time_of(&self, process: usize, input: &Input) -> Time {
        let is_loss = matches!(input, Input::MembershipChanged(MembershipFact::NodeLost { .. }));
        let is_early = is_loss && self.fault == Some(Fault::LossReportedEarly);
        let at = if is_early { self.now - TOO_EARLY } else { self.now };
        if self.fault == Some(Fault::ClocksConfused)
            && let Input::ArrivalsReceived { from, .. } | Input::ListReceived { from, .. } = input
        {
            let from = (from.bits() - address(0).bits()) as usize;
            return self.clocks.read(from, at);
        }
        self.clocks.read(process, at)
    }

    /// Returns a list, as a node sends it.
    pub(super) fn sent_list(&self, payload: Bytes) -> Bytes {
        let phases: Vec<Name> = match self.fault {
            Some(Fault::PhasesLeftOut) => Vec::new(),
            Some(Fault::PhasesMadeUp) => {
                PHASES.iter().map(|(phase, _)| Name::try_from((*phase).to_owned()).unwrap()).collect()
            }
            Some(_) | None => return payload,
        };
        let mut list = List::parse(&payload).unwrap();
        list.entries.iter_mut().for_each(|entry| entry.phases.clone_from(&phases));
        list.encode_within(NodeConfig::new("n").payload_max, usize::MAX).0
    }

    /// Returns the states of a node's barriers, as it reports them.
    pub(super) fn statuses(&mut self, node: usize) -> Vec<BarrierStatus> {
        let mut statuses = self.cores[node].barriers(self.clock(node));
        for status in &mut statuses {
            for absence in &mut status.missing {
                absence.why = self.reported_reason(node, &absence.name, &absence.why).into();
            }
            let longest = status.waiting.iter().map(|(_, waited)| *waited).max();
            for absence in status.missing.iter_mut().filter(|_| self.fault == Some(Fault::AbsenceOverstated))
            {
                absence.since = longest.unwrap_or_default();
            }
            if self.fault == Some(Fault::ArrivedNamed)
                && let Some((name, since)) = status.waiting.first().cloned()
            {
                status.missing.push(Absence { name, why: "ready, has not arrived".into(), since });
            }
        }
        statuses
    }

    /// Returns an answer, as a node gives it.
    pub(super) fn reported_answer(&mut self, node: usize, answer: BarrierAnswer) -> BarrierAnswer {
        let mut reported = |missing: Vec<(String, String)>| -> Vec<(String, String)> {
            let pairs = missing.into_iter().map(|(name, why)| {
                let why = self.reported_reason(node, &name, &why);
                (name, why)
            });
            pairs.collect()
        };
        match answer {
            BarrierAnswer::TimedOut { missing } => BarrierAnswer::TimedOut { missing: reported(missing) },
            BarrierAnswer::Lost { missing } => BarrierAnswer::Lost { missing: reported(missing) },
            BarrierAnswer::Opened { .. } | BarrierAnswer::Refused { .. } => answer,
        }
    }

    fn reported_reason(&mut self, node: usize, name: &str, why: &str) -> String {
        match self.fault {
            Some(Fault::WrongReason) if why == Reason::LinkDown.words() => {
                Reason::NodeLost.words().to_owned()
            }
            Some(Fault::ReasonKept) => {
                self.reasons.entry((node, name.to_owned())).or_insert_with(|| why.to_owned()).clone()
            }
            Some(_) | None => why.to_owned(),
        }
    }
}
