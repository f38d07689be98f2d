//! The coordinator of a transaction: it begins one, asks for the outcomes, and repairs a mixed one. Pure: times are
//! arguments, and the caller sends.
//!
//! The participants agree without it ([`agreement`](crate::agreement)): after the begin they do not need it.

use std::{collections::BTreeSet, time::Duration};

use crate::{
    LEAD_MAX, LEAD_MIN, NamedValue, PARTICIPANTS_MAX, ParameterOutcome, ParameterTransaction, Participant,
    SetParameters, TransactionId,
};

/// Time between two questions for the outcome: a tick of a usual loop is not much longer.
const ASK_AGAIN: Duration = Duration::from_millis(20);
/// The same later than one lead after the stated time, when an application is silent or restarts.
const REPAIR_AGAIN: Duration = Duration::from_millis(200);
/// How long to wait for an outcome: one that is silent must not delay the repair of others.
const ASKED_WITHIN: Duration = Duration::from_millis(300);

/// The reason why a transaction cannot begin. Nothing was sent. The caller is at fault.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TransactionError {
    /// It has no application, or too many ones.
    #[error("a transaction is about 1 to {PARTICIPANTS_MAX} applications, not {0}: split it")]
    Participants(usize),
    /// An application stands twice in it.
    #[error("{0} stands twice in the transaction: give it one list of values")]
    Twice(String),
    /// The lead is outside of its range.
    #[error("the stated time of a transaction is 20 ms to 2 s after its begin, not {0:?}")]
    Lead(Duration),
    /// No application has this name.
    #[error("no application is called {0}, and nothing was set; `sinew apps` lists the names")]
    UnknownName(String),
}

/// The next step of a coordinator.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Send this to the participant with this index as a request, and call [`Coordinator::answered`] with the reply.
    Ask {
        /// The index of the participant, in the order of the begin.
        index: usize,
        /// The request.
        set: SetParameters,
        /// How long to wait for the reply.
        within: Duration,
    },
    /// Wait until this time of the coordinator's clock.
    Wait(Duration),
    /// The transaction has ended: see [`Coordinator::report`].
    Done,
}

/// The result of a transaction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TransactionVerdict {
    /// All applications have applied their values, or do so at their next tick.
    All,
    /// No application that answers has applied its values.
    None,
    /// Some had applied their values at the stated time, and others had not. All have them now.
    Repaired,
    /// Some have applied their values, and others have not, or do not answer.
    Mixed,
}

/// The outcome of a transaction for one application.
#[derive(Clone, Debug, PartialEq)]
pub enum PartOutcome {
    /// The values were applied at this tick, at this time of the application's clock.
    Applied {
        /// The number of the tick; 0 without a periodic timer.
        tick: u64,
        /// The time in nanoseconds.
        at_ns: u64,
    },
    /// The values were not applied at the stated time, but later, to repair a mixed transaction.
    Repaired {
        /// The number of the tick; 0 without a periodic timer.
        tick: u64,
        /// The time in nanoseconds.
        at_ns: u64,
    },
    /// All have accepted, and the application applies the values at its next tick, which has not come yet.
    Agreed,
    /// The values were not applied, for this reason.
    Refused(String),
    /// It is not known whether the values were applied, for this reason.
    Unknown(String),
}

/// One application in a report.
#[derive(Clone, Debug, PartialEq)]
pub struct PartReport {
    /// Its name.
    pub app: String,
    /// Its values.
    pub values: Vec<NamedValue>,
    /// The stated time on its clock in nanoseconds, and the maximum error of that; `None` if it has not accepted.
    pub stated: Option<(u64, u64)>,
    /// The outcome.
    pub outcome: PartOutcome,
}

/// The report of a transaction.
#[derive(Clone, Debug, PartialEq)]
pub struct TransactionReport {
    /// The transaction.
    pub id: TransactionId,
    /// The result.
    pub verdict: TransactionVerdict,
    /// Each application, in the order of the begin.
    pub parts: Vec<PartReport>,
}

/// A transaction, from its begin to its report.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew_params::{Coordinator, LEAD, NamedValue, Participant, Step, Value};
///
/// let gain = vec![NamedValue { name: "gain".to_owned(), value: Value::Number(0.2) }];
/// let knee = (Participant { tid: 7, app: "knee".to_owned() }, gain);
/// let within = Duration::from_secs(2);
/// let mut transaction = Coordinator::begin(9, vec![knee], (LEAD, within), Duration::ZERO).expect("it has one application");
/// assert!(matches!(transaction.next(Duration::ZERO), Step::Ask { index: 0, .. }));
/// ```
#[derive(Debug)]
pub struct Coordinator {
    id: TransactionId,
    lead: Duration,
    began: Duration,
    /// The last time to wait for outcomes and for a repair.
    until: Duration,
    participants: Vec<Participant>,
    parts: Vec<Part>,
    phase: Phase,
    /// The participants that are asked in this round.
    round: BTreeSet<usize>,
    next_round: Duration,
    /// The participant that was asked last, until its reply.
    asked: Option<usize>,
}

#[derive(Debug)]
struct Part {
    values: Vec<NamedValue>,
    stated: Option<(u64, u64)>,
    outcome: PartOutcome,
    /// Whether no question would change the outcome.
    is_final: bool,
    /// Whether it had not applied the values when it was asked after the stated time.
    has_missed: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Prepare,
    /// After the stated time: outcomes, and the repair of a mixed transaction.
    Conclude,
    Done,
}

impl Coordinator {
    /// Begins a transaction now. It applies `lead` after now, and `within` after that the coordinator waits no longer
    /// for outcomes and for a repair. `coordinator` is its TID as bits.
    ///
    /// # Errors
    /// There are no or too many applications, one stands twice, or the lead is outside of its range.
    pub fn begin(
        coordinator: u64,
        sets: Vec<(Participant, Vec<NamedValue>)>,
        (lead, within): (Duration, Duration),
        now: Duration,
    ) -> Result<Self, TransactionError> {
        if sets.is_empty() || sets.len() > PARTICIPANTS_MAX {
            return Err(TransactionError::Participants(sets.len()));
        }
        if !(LEAD_MIN..=LEAD_MAX).contains(&lead) {
            return Err(TransactionError::Lead(lead));
        }
        let mut tids = BTreeSet::new();
        if let Some((twice, _)) = sets.iter().find(|(one, _)| !tids.insert(one.tid)) {
            return Err(TransactionError::Twice(twice.app.clone()));
        }
        let (participants, values): (Vec<_>, Vec<_>) = sets.into_iter().unzip();
        let not_asked =
            || PartOutcome::Refused("it was not asked, as another application refused".to_owned());
        let part =
            |values| Part { values, stated: None, outcome: not_asked(), is_final: true, has_missed: false };
        Ok(Self {
            id: TransactionId { coordinator, began_ns: nanos(now) },
            lead,
            began: now,
            until: now.saturating_add(lead).saturating_add(within),
            round: (0..participants.len()).collect(),
            participants,
            parts: values.into_iter().map(part).collect(),
            phase: Phase::Prepare,
            next_round: now,
            asked: None,
        })
    }

    /// Returns the next step. For [`Step::Ask`], `now` is to be as close to the sending as possible: the stated time is
    /// sent as its distance from that.
    pub fn next(&mut self, now: Duration) -> Step {
        if self.round.is_empty() || now >= self.until {
            self.end_round(now);
        }
        if self.phase == Phase::Done {
            return Step::Done;
        }
        if now < self.next_round {
            return Step::Wait(self.next_round);
        }
        let Some(index) = self.round.pop_first() else { return Step::Wait(now + ASK_AGAIN) };
        let set = self.request(index, now);
        self.asked = Some(index);
        Step::Ask { index, set, within: self.patience(now) }
    }

    /// Takes the reply to the last [`Step::Ask`], or the reason why there is none.
    pub fn answered(&mut self, reply: Result<ParameterOutcome, String>) {
        let Some(index) = self.asked.take() else { return };
        let is_begin = self.phase == Phase::Prepare;
        let part = &mut self.parts[index];
        part.is_final = false;
        part.outcome = match reply {
            Ok(ParameterOutcome::Held { stated_ns, bound_ns, is_agreed }) => {
                part.stated = Some((stated_ns, bound_ns));
                let why = || "it accepted, and its outcome is not known".to_owned();
                if is_agreed { PartOutcome::Agreed } else { PartOutcome::Unknown(why()) }
            }
            Ok(ParameterOutcome::Applied { tick, at_ns, .. }) => {
                part.is_final = true;
                if part.has_missed {
                    PartOutcome::Repaired { tick, at_ns }
                } else {
                    PartOutcome::Applied { tick, at_ns }
                }
            }
            Ok(ParameterOutcome::Refused { why }) => {
                part.has_missed = true;
                part.is_final = is_begin;
                PartOutcome::Refused(why)
            }
            Err(why) => PartOutcome::Unknown(why),
        };
        if is_begin && part.is_final {
            // It cannot be agreed on any more.
            self.round.clear();
        }
    }

    /// Returns the participant with this index.
    #[must_use]
    pub fn participant(&self, index: usize) -> Option<&Participant> {
        self.participants.get(index)
    }

    /// Returns the report, when [`next`](Self::next) has returned [`Step::Done`].
    #[must_use]
    pub fn report(self) -> TransactionReport {
        let verdict = self.verdict();
        let parts = self.participants.into_iter().zip(self.parts).map(|(one, part)| PartReport {
            app: one.app,
            values: part.values,
            stated: part.stated,
            outcome: part.outcome,
        });
        TransactionReport { id: self.id, verdict, parts: parts.collect() }
    }

    fn request(&self, index: usize, now: Duration) -> SetParameters {
        let part = &self.parts[index];
        if self.phase == Phase::Prepare {
            return SetParameters::Prepare(ParameterTransaction {
                id: self.id,
                participants: self.participants.clone(),
                values: part.values.clone(),
                lead_ns: nanos(self.lead),
                applies_after_ns: nanos((self.began + self.lead).saturating_sub(now)),
            });
        }
        let is_missed = matches!(part.outcome, PartOutcome::Refused(_));
        if is_missed && self.verdict() == TransactionVerdict::Mixed {
            return SetParameters::Values(part.values.clone());
        }
        SetParameters::Conclude(self.id)
    }

    /// Returns how long to wait for a reply.
    fn patience(&self, now: Duration) -> Duration {
        // A participant that is silent must not keep the others from accepting in time.
        let decide_by = self.began + self.lead / 2;
        let until = if self.phase == Phase::Prepare { decide_by } else { self.until.min(now + ASKED_WITHIN) };
        until.saturating_sub(now).max(LEAD_MIN)
    }

    /// Begins the next round, or ends the transaction.
    fn end_round(&mut self, now: Duration) {
        let apply_at = self.began + self.lead;
        if self.phase == Phase::Prepare {
            self.phase = Phase::Conclude;
            self.next_round = apply_at;
        } else {
            self.next_round = now + if now < apply_at + self.lead { ASK_AGAIN } else { REPAIR_AGAIN };
        }
        let open = self.parts.iter().enumerate().filter(|(_, part)| !part.is_final);
        self.round = open.map(|(index, _)| index).collect();
        if self.round.is_empty() || now >= self.until || self.is_without_effect(now) {
            self.phase = Phase::Done;
        }
    }

    /// Returns whether no application has applied anything, as far as those that answer know.
    fn is_without_effect(&self, now: Duration) -> bool {
        let has_refused = |part: &Part| matches!(part.outcome, PartOutcome::Refused(_));
        let is_late = now >= self.began + self.lead * 2;
        self.verdict() == TransactionVerdict::None && (is_late || self.parts.iter().all(has_refused))
    }

    fn verdict(&self) -> TransactionVerdict {
        let count = |is: fn(&PartOutcome) -> bool| self.parts.iter().filter(|part| is(&part.outcome)).count();
        let in_time = count(|outcome| matches!(outcome, PartOutcome::Applied { .. } | PartOutcome::Agreed));
        let repaired = count(|outcome| matches!(outcome, PartOutcome::Repaired { .. }));
        match in_time + repaired {
            0 => TransactionVerdict::None,
            all if all < self.parts.len() => TransactionVerdict::Mixed,
            _ if repaired > 0 => TransactionVerdict::Repaired,
            _ => TransactionVerdict::All,
        }
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Value;

    const WITHIN: Duration = Duration::from_secs(1);

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn begin(count: u64) -> Coordinator {
        let gain = || vec![NamedValue { name: "gain".to_owned(), value: Value::Number(0.2) }];
        let sets = (0..count).map(|tid| (Participant { tid, app: format!("app-{tid}") }, gain()));
        Coordinator::begin(99, sets.collect(), (ms(100), WITHIN), ms(0)).expect("it is legal")
    }

    fn held(is_agreed: bool) -> Result<ParameterOutcome, String> {
        Ok(ParameterOutcome::Held { stated_ns: 7, bound_ns: 1, is_agreed })
    }

    fn applied() -> Result<ParameterOutcome, String> {
        Ok(ParameterOutcome::Applied { tick: 3, at_ns: 8, values: Vec::new() })
    }

    fn refused() -> Result<ParameterOutcome, String> {
        Ok(ParameterOutcome::Refused { why: "no".to_owned() })
    }

    /// Runs the coordinator; `answer` gets the index and the request. Requests take 1 ms.
    fn run(
        mut coordinator: Coordinator,
        mut answer: impl FnMut(usize, &SetParameters, Duration) -> Result<ParameterOutcome, String>,
    ) -> TransactionReport {
        let mut now = ms(0);
        for _ in 0..10_000 {
            match coordinator.next(now) {
                Step::Ask { index, set, .. } => {
                    coordinator.answered(answer(index, &set, now));
                    now += ms(1);
                }
                Step::Wait(until) => now = now.max(until),
                Step::Done => return coordinator.report(),
            }
        }
        panic!("it does not end: {coordinator:?}");
    }

    #[test]
    fn all_have_applied() {
        let report = run(begin(3), |_, set, now| match set {
            SetParameters::Prepare(one) => {
                assert_eq!(Duration::from_nanos(one.applies_after_ns) + now, ms(100));
                held(false)
            }
            SetParameters::Conclude(_) if now < ms(130) => held(true),
            SetParameters::Conclude(_) => applied(),
            SetParameters::Values(_) | SetParameters::Undo => panic!("nothing is repaired"),
        });
        assert_eq!(report.verdict, TransactionVerdict::All);
        assert!(report.parts.iter().all(|part| part.stated == Some((7, 1))), "{report:?}");
    }

    #[test]
    fn refusal_ends_the_begin_and_names_the_reason() {
        let mut asked = Vec::new();
        let report = run(begin(3), |index, set, _| match set {
            SetParameters::Prepare(_) => {
                asked.push(index);
                if index == 1 { refused() } else { held(false) }
            }
            SetParameters::Conclude(_) => refused(),
            SetParameters::Values(_) | SetParameters::Undo => panic!("nothing is repaired"),
        });
        assert_eq!((report.verdict, asked), (TransactionVerdict::None, vec![0, 1]));
        assert_eq!(report.parts[1].outcome, PartOutcome::Refused("no".to_owned()));
    }

    #[test]
    fn restarted_participant_is_repaired() {
        let report = run(begin(3), |index, set, now| match (index, set) {
            (_, SetParameters::Prepare(_)) => held(false),
            (2, SetParameters::Conclude(_)) => refused(),
            (2, SetParameters::Values(_)) if now < ms(500) => Err("it has ended".to_owned()),
            (2, SetParameters::Values(_)) => applied(),
            (_, SetParameters::Conclude(_)) => applied(),
            (_, SetParameters::Values(_) | SetParameters::Undo) => panic!("it has its values"),
        });
        assert_eq!(report.verdict, TransactionVerdict::Repaired);
        assert_eq!(report.parts[2].outcome, PartOutcome::Repaired { tick: 3, at_ns: 8 });
    }

    #[test]
    fn silent_participant_is_named_and_ends_the_wait() {
        let report = run(begin(2), |index, set, _| match (index, set) {
            (_, SetParameters::Prepare(_)) => held(false),
            (0, _) => applied(),
            (_, _) => Err("no answer".to_owned()),
        });
        assert_eq!(report.verdict, TransactionVerdict::Mixed);
        assert_eq!(report.parts[1].outcome, PartOutcome::Unknown("no answer".to_owned()));
    }

    #[test]
    fn illegal_transactions_do_not_begin() {
        let one = || (Participant { tid: 1, app: "knee".to_owned() }, Vec::new());
        let begin = |sets, lead| Coordinator::begin(9, sets, (lead, WITHIN), ms(0)).map(|_| ());
        assert_eq!(begin(Vec::new(), ms(100)), Err(TransactionError::Participants(0)));
        assert_eq!(begin(vec![one(), one()], ms(100)), Err(TransactionError::Twice("knee".to_owned())));
        assert_eq!(begin(vec![one()], ms(1)), Err(TransactionError::Lead(ms(1))));
        let many = (0..17).map(|tid| (Participant { tid, app: "knee".to_owned() }, Vec::new()));
        assert_eq!(begin(many.collect(), ms(100)), Err(TransactionError::Participants(17)));
    }
}
