//! Faults that are planted into what nodes say, remember and are asked: each must be found.

use super::*;
use crate::sync::{list::List, words::BarrierStatus};

/// A loss is told so much too early: no more than what is nothing to a timer.
const TOO_EARLY: Duration = Duration::from_millis(10);

/// A fault in what nodes say to each other and to applications, or in what they remember.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fault {
    /// Who waits is said to wait behind the newest generation that its receiver knows.
    GenerationsConfused,
    /// Who passed is not said.
    MembersLeftOut,
    /// Who passed an earlier generation than the last is not said.
    EarlierLeftOut,
    /// A node says of everybody who ever waited that they wait.
    DeparturesHidden,
    /// Of two nodes with one address the younger is believed, also when the elder is linked.
    YoungerBelieved,
    /// It is forgotten who was at a barrier before, so that it makes way for another one.
    VisitsForgotten,
    /// What the successor of an actor that failed is handed again is taken in again.
    HandledAgain,
    /// No wait has a deadline.
    DeadlineForgotten,
    /// A wait is over after half of its time.
    TimedOutEarly,
    /// Who wants to be told of a loss is not.
    FailNotTold,
    /// Who wants to wait for a lost party's return is told of the loss.
    LossToldUnasked,
    /// A loss is told while the word of an opening may still be on its way.
    LossToldEarly,
    /// Of a node whose link is down it is said that it was lost.
    WrongReason,
    /// The reason that was given first for a name is given ever after.
    ReasonKept,
    /// Who has arrived is said to be missing.
    ArrivedNamed,
    /// Who is missing is said to have been for as long as somebody has waited.
    AbsenceOverstated,
    /// What another node says is taken to be said when that one's clock says so.
    ClocksConfused,
    /// Who has reached a phase is not said.
    PhasesLeftOut,
    /// All are said to have reached each phase.
    PhasesMadeUp,
}

impl Fault {
    pub(super) const ALL: [Self; 19] = [
        Self::GenerationsConfused,
        Self::MembersLeftOut,
        Self::EarlierLeftOut,
        Self::DeparturesHidden,
        Self::YoungerBelieved,
        Self::VisitsForgotten,
        Self::HandledAgain,
        Self::DeadlineForgotten,
        Self::TimedOutEarly,
        Self::FailNotTold,
        Self::LossToldUnasked,
        Self::LossToldEarly,
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
    /// What a node takes for the time that an application asks for, in milliseconds, and for its wish where a party is lost.
    pub(super) fn misheard(&self, within_ms: u32, on_loss: OnPartyLoss) -> (u32, OnPartyLoss) {
        match self.fault {
            Some(Fault::DeadlineForgotten) => (FOR_EVER_MS, on_loss),
            Some(Fault::TimedOutEarly) => (within_ms / 2, on_loss),
            Some(Fault::FailNotTold) => (within_ms, OnPartyLoss::Wait),
            Some(Fault::LossToldUnasked) => (within_ms, OnPartyLoss::Fail),
            Some(_) | None => (within_ms, on_loss),
        }
    }

    /// When a process takes something to be told.
    pub(super) fn time_of(&self, process: usize, input: &Input) -> Time {
        let is_loss = matches!(input, Input::MembershipChanged(MembershipFact::NodeLost { .. }));
        let is_early = is_loss && self.fault == Some(Fault::LossToldEarly);
        let at = if is_early { self.now - TOO_EARLY } else { self.now };
        if self.fault == Some(Fault::ClocksConfused)
            && let Input::ArrivalsReceived { from, .. } | Input::ListReceived { from, .. } = input
        {
            let from = (from.bits() - address(0).bits()) as usize;
            return self.clocks.read(from, at);
        }
        self.clocks.read(process, at)
    }

    /// A list, as a node says it.
    pub(super) fn list_said(&self, payload: Bytes) -> Bytes {
        let phases: Vec<Name> = match self.fault {
            Some(Fault::PhasesLeftOut) => Vec::new(),
            Some(Fault::PhasesMadeUp) => {
                PHASES.iter().map(|(phase, _)| Name::try_from((*phase).to_owned()).unwrap()).collect()
            }
            Some(_) | None => return payload,
        };
        let mut list = List::parse(&payload).unwrap();
        list.entries.iter_mut().for_each(|entry| entry.phases.clone_from(&phases));
        list.encode(NodeConfig::new("n").payload_max).0
    }

    /// How a node's barriers stand, as it says.
    pub(super) fn statuses(&mut self, node: usize) -> Vec<BarrierStatus> {
        let mut statuses = self.cores[node].barriers(self.clock(node));
        for status in &mut statuses {
            for absence in &mut status.missing {
                absence.why = self.reason_said(node, &absence.name, &absence.why).into();
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

    /// An answer, as a node gives it.
    pub(super) fn answer_said(&mut self, node: usize, answer: BarrierAnswer) -> BarrierAnswer {
        let mut said = |missing: Vec<(String, String)>| -> Vec<(String, String)> {
            let said = missing.into_iter().map(|(name, why)| {
                let why = self.reason_said(node, &name, &why);
                (name, why)
            });
            said.collect()
        };
        match answer {
            BarrierAnswer::TimedOut { missing } => BarrierAnswer::TimedOut { missing: said(missing) },
            BarrierAnswer::Lost { missing } => BarrierAnswer::Lost { missing: said(missing) },
            BarrierAnswer::Opened { .. } | BarrierAnswer::Refused { .. } => answer,
        }
    }

    fn reason_said(&mut self, node: usize, name: &str, why: &str) -> String {
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
