//! Faults in the core's behaviour, planted from outside: each must be found.

use std::collections::BTreeMap;

use sinew_runtime::time::Time;

use super::network::{Flying, What};
use crate::ndl::{
    LossReason, MembershipFact, NodeEvent,
    core::{
        Core, Input, Output, Place,
        contact::{Question, Role},
    },
    datagram::{Announcement, Body, Datagram, parse},
};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// An answer does not clear what was missed before it.
    ForgetsAnAnswer,
    /// A late timer is taken for a timely one.
    CountsItsOwnStall,
    /// Who is always late himself accuses nobody for ever.
    PutsOffForEver,
    /// A former life that answers replaces the present one.
    IgnoresIncarnation,
    /// A goodbye is not heard.
    DropsALeave,
    /// A node that stops tells nobody.
    SaysNoGoodbye,
    /// Answers to questions from before a loss count.
    TakesLateAnswers,
    /// One missed answer fewer than is allowed is a loss.
    LosesEarly,
    /// One missed answer more than is allowed is none.
    LosesLate,
    /// What a host says of a silent node is not heard.
    IgnoresHosts,
    /// A host is tried at addresses that other hosts have, too, and what any one of them says counts.
    TakesAnybodysWord,
    /// What GNCL hears is not heard.
    IgnoresSigns,
    /// What GNCL heard once counts for ever.
    TakesOldSignsForNew,
    /// Groups of the configuration are watched like everybody.
    HasOnePaceForAll,
    /// Who is lost is never asked again.
    ForgetsTheFormer,
    /// What the bound of a clock is, is said to be half of it.
    BoastsOfItsClock,
    /// Nobody is told of a loss by silence.
    KeepsALossToItself,
    /// A member that does not answer at one of its addresses is silent.
    JudgesByOneRoute,
    /// Applications are not told of a loss.
    KeepsALossFromApplications,
    /// Applications are told of a loss twice.
    TellsALossTwice,
    /// Applications are told that a node that crashed hangs.
    TellsAnotherClass,
    /// Applications are told that a node was heard just before it was lost.
    TellsThatItWasJustHeard,
    /// Applications are not told what does not get on.
    KeepsATroubleToItself,
    /// Applications are not told what gets on again.
    NeverTellsThatItGetsOn,
}

impl Fault {
    pub(super) const ALL: [Self; 24] = [
        Self::ForgetsAnAnswer,
        Self::CountsItsOwnStall,
        Self::PutsOffForEver,
        Self::IgnoresIncarnation,
        Self::DropsALeave,
        Self::SaysNoGoodbye,
        Self::TakesLateAnswers,
        Self::LosesEarly,
        Self::LosesLate,
        Self::HasOnePaceForAll,
        Self::IgnoresHosts,
        Self::TakesAnybodysWord,
        Self::IgnoresSigns,
        Self::TakesOldSignsForNew,
        Self::ForgetsTheFormer,
        Self::BoastsOfItsClock,
        Self::KeepsALossToItself,
        Self::JudgesByOneRoute,
        Self::KeepsALossFromApplications,
        Self::TellsALossTwice,
        Self::TellsAnotherClass,
        Self::TellsThatItWasJustHeard,
        Self::KeepsATroubleToItself,
        Self::NeverTellsThatItGetsOn,
    ];
}

/// How often an application is told something.
enum Telling {
    Never,
    Once,
    Twice,
}

/// A core, and the fault of it.
pub(super) struct Patient {
    pub(super) core: Core,
    fault: Option<Fault>,
    /// What is told once more.
    again: Option<Output>,
}

impl Patient {
    pub(super) fn new(mut core: Core, fault: Option<Fault>) -> Self {
        match fault {
            Some(Fault::LosesEarly) => core.paces.iter_mut().for_each(|pace| pace.missed_max -= 1),
            Some(Fault::LosesLate) => core.paces.iter_mut().for_each(|pace| pace.missed_max += 1),
            Some(Fault::HasOnePaceForAll) => core.paces.truncate(1),
            Some(_) | None => {}
        }
        Self { core, fault, again: None }
    }

    pub(super) fn receive(&mut self, now: Time, flying: &Flying) {
        match self.fault {
            Some(Fault::DropsALeave) if flying.what == What::Leave => return,
            Some(Fault::IgnoresIncarnation) => self.make_way_for_former_life(now, flying),
            Some(Fault::TakesLateAnswers) => self.ask_again(now, flying),
            Some(_) | None => {}
        }
        // Only then: the cost of a core is measured here, and must not grow with what a fault needs.
        let missed: Option<BTreeMap<_, _>> = (self.fault == Some(Fault::ForgetsAnAnswer))
            .then(|| self.core.members.iter().map(|(node, member)| (*node, member.missed)).collect());
        self.core.receive(now, place(flying), flying.way, &flying.bytes);
        if let Some(missed) = missed {
            for (node, member) in &mut self.core.members {
                member.missed = missed.get(node).copied().unwrap_or(0);
            }
        }
    }

    pub(super) fn told(&mut self, now: Time, input: Input) {
        let input = match (self.fault, input) {
            (Some(Fault::IgnoresHosts), Input::Probed { .. })
            | (Some(Fault::IgnoresSigns), Input::SignSeen { .. }) => return,
            (Some(Fault::TakesOldSignsForNew), Input::SignSeen { node, incarnation, .. }) => {
                Input::SignSeen { node, incarnation, at: now }
            }
            (_, input) => input,
        };
        self.core.handle(now, input);
    }

    fn make_way_for_former_life(&mut self, now: Time, flying: &Flying) {
        let Ok(Datagram { correlation, body: Body::Answer(answer), .. }) =
            parse(self.core.me.node, &flying.bytes)
        else {
            return;
        };
        let Announcement { node, incarnation, .. } = answer.announcement;
        let member = self.core.members.get(&node).map(|member| member.announcement.incarnation);
        let is_taken =
            self.core.contacts.get(&place(flying)).is_some_and(|contact| contact.questions.has(correlation));
        if is_taken && member.is_some_and(|known| incarnation < known) {
            self.core.lose(now, node, LossReason::Restarted);
            self.core.gone.remove(&node);
            self.ask_again(now, flying);
        }
    }

    fn ask_again(&mut self, now: Time, flying: &Flying) {
        if let What::Answer(correlation) = flying.what
            && let Some(mut contact) = self.core.contacts.get_mut(&place(flying))
            && !contact.questions.has(correlation)
        {
            contact.questions.push(Question { correlation, asked: now }, 4);
        }
    }

    pub(super) fn time_passed(&mut self, now: Time) {
        while self.fault == Some(Fault::CountsItsOwnStall)
            && let Some(due) = self.core.next_wake().filter(|due| *due < now)
        {
            self.core.handle(due, Input::TimePassed);
        }
        if self.fault == Some(Fault::PutsOffForEver) {
            for pace in &mut self.core.paces {
                pace.late_in_a_row = 0;
                pace.respite.iter_mut().for_each(|respite| respite.in_a_row = 0);
            }
        }
        if self.fault == Some(Fault::JudgesByOneRoute) {
            for member in self.core.members.values_mut() {
                let missed = member.routes.iter().map(|route| route.missed).max();
                member.missed = member.missed.max(missed.unwrap_or(0));
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
                match self.tell(event) {
                    Telling::Once => {}
                    Telling::Twice => self.again = Some(output.clone()),
                    Telling::Never => continue,
                }
            }
            match (self.fault, &mut output) {
                (Some(Fault::SaysNoGoodbye), Output::SendLeave { .. }) => {}
                (Some(Fault::TakesAnybodysWord), Output::Probe { node, to, .. }) => {
                    *to = self.core.members[node].announcement.gncl_addresses(None, []);
                    return Some(output);
                }
                (Some(Fault::BoastsOfItsClock), Output::ClockMeasured { offset, .. }) => {
                    offset.bound /= 2;
                    return Some(output);
                }
                (Some(Fault::KeepsALossToItself), Output::Fact(fact)) if is_silence(fact) => {}
                (Some(Fault::ForgetsTheFormer), Output::Fact(fact)) if is_silence(fact) => {
                    self.forget_the_former();
                    return Some(output);
                }
                _ => return Some(output),
            }
        }
    }

    /// What becomes of an event for applications.
    fn tell(&self, event: &mut NodeEvent) -> Telling {
        match (self.fault, event) {
            (Some(Fault::KeepsALossFromApplications), NodeEvent::NodeLost { .. })
            | (Some(Fault::KeepsATroubleToItself), NodeEvent::AppStalled { .. })
            | (Some(Fault::NeverTellsThatItGetsOn), NodeEvent::AppResumed { .. }) => Telling::Never,
            (Some(Fault::TellsALossTwice), NodeEvent::NodeLost { .. }) => Telling::Twice,
            (Some(Fault::TellsAnotherClass), NodeEvent::NodeLost { why, .. }) => {
                if matches!(why, LossReason::Crashed) {
                    *why = LossReason::Hung;
                }
                Telling::Once
            }
            (Some(Fault::TellsThatItWasJustHeard), NodeEvent::NodeLost { silent_us, .. }) => {
                *silent_us = 0;
                Telling::Once
            }
            _ => Telling::Once,
        }
    }

    fn forget_the_former(&mut self) {
        let contacts = &mut self.core.contacts;
        contacts.retain(|_, contact| !matches!(contact.role, Role::Former { .. }));
    }
}

const fn place(flying: &Flying) -> Place {
    Place { there: flying.from, here: flying.to }
}

const fn is_silence(fact: &MembershipFact) -> bool {
    use LossReason::{Crashed, Hung, LinkDown};
    matches!(fact, MembershipFact::NodeLost { why: Crashed | Hung | LinkDown, .. })
}
