//! The transactions of an application with others: at most one at a time, and the outcomes of the last ones.

#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, VecDeque},
    time::Duration,
};

use super::{ParameterError, Tuner, Values, nanos, refused};
use crate::{
    LEAD_MAX, LEAD_MIN, PARTICIPANTS_MAX, ParameterOutcome, ParameterTransaction, ParameterVote, Stance,
    TransactionId,
    agreement::{Agreement, Outbox, Times},
};

/// Maximum number of transactions with a known outcome. The oldest one is forgotten.
const CONCLUDED_MAX: usize = 16;

/// Maximum error of the stated time, as a part of the lead. If the clock of one participant is late by it, and that of
/// another is early by it, a quarter of the lead is left for the result.
const CLOCK_SHARE: u32 = 8;

/// Time between two looks at whether an application without a next tick can apply agreed values: its timer may have
/// been cancelled.
const APPLY_AGAIN: Duration = Duration::from_millis(100);

/// The transactions of one incarnation of an application.
#[derive(Default)]
pub(super) struct Transactions {
    current: Option<Current>,
    concluded: VecDeque<(TransactionId, ParameterOutcome)>,
    outbox: Outbox,
    /// The last transaction that was applied after it had been refused.
    late: Option<TransactionId>,
}

/// The transaction in which the application takes part.
struct Current {
    agreement: Agreement,
    values: Values,
    bound: Duration,
    /// Whether no other set may change the parameters: until the values apply, or until the stated time without a known
    /// result.
    is_holding: bool,
    /// When an application without ticks applies the values.
    apply_at: Duration,
}

impl Transactions {
    /// Returns whether no other set may change the parameters.
    pub(super) fn holds(&self) -> bool {
        self.current.as_ref().is_some_and(|current| current.is_holding)
    }

    /// Ends a doubt, as another set was accepted: values that were agreed on before it do not apply after it.
    pub(super) fn supersede(&mut self) {
        self.current = self.current.take().filter(|current| current.is_holding);
    }

    /// Returns when there is something to do next.
    pub(super) fn next_wake(&self) -> Option<Duration> {
        let current = self.current.as_ref()?;
        current.agreement.next_wake().or_else(|| current.agreement.is_committed().then_some(current.apply_at))
    }

    pub(super) const fn is_idle(&self) -> bool {
        self.current.is_none()
    }

    /// Returns the values that are agreed on and apply soon.
    fn agreed(&self) -> Option<&Values> {
        let current = self.current.as_ref().filter(|current| current.is_holding)?;
        current.agreement.is_committed().then_some(&current.values)
    }

    /// Takes the steps that are due. A result that is not known at the stated time is a refusal.
    fn advance(&mut self, now: Duration) {
        let Some(current) = &mut self.current else { return };
        current.agreement.on_time(now, &mut self.outbox);
        if now >= current.apply_at {
            current.apply_at = now + APPLY_AGAIN;
        }
        let agreement = &current.agreement;
        if current.is_holding && !agreement.is_committed() && now >= agreement.times().apply_at {
            current.is_holding = false;
            let why = ParameterError::NotAgreed { missing: agreement.missing().join(", ") };
            let id = agreement.id();
            self.conclude(id, refused(&why));
        }
        self.current = self.current.take().filter(|current| !current.agreement.is_ended());
    }

    fn conclude(&mut self, id: TransactionId, outcome: ParameterOutcome) {
        self.concluded.retain(|(other, _)| *other != id);
        if self.concluded.len() >= CONCLUDED_MAX {
            self.concluded.pop_front();
        }
        self.concluded.push_back((id, outcome));
    }

    fn outcome_of(&self, id: TransactionId) -> Option<ParameterOutcome> {
        let current =
            self.current.as_ref().filter(|current| current.agreement.id() == id && current.is_holding);
        let held = |current: &Current| ParameterOutcome::Held {
            stated_ns: nanos(current.agreement.times().apply_at),
            bound_ns: nanos(current.bound),
            is_agreed: current.agreement.is_committed(),
        };
        let concluded =
            || self.concluded.iter().find(|(other, _)| *other == id).map(|(_, known)| known.clone());
        current.map(held).or_else(concluded)
    }

    fn on_vote(&mut self, now: Duration, from: u64, vote: ParameterVote) {
        self.advance(now);
        let ParameterVote { transaction, stance } = vote;
        if let Some(current) = &mut self.current
            && current.agreement.id() == transaction
        {
            current.agreement.on_vote(now, from, stance, &mut self.outbox);
            self.advance(now);
            return;
        }
        let known = self.concluded.iter().find(|(other, _)| *other == transaction).map(|(_, known)| known);
        let is_applied = known.map(|known| matches!(known, ParameterOutcome::Applied { .. }));
        let answer = match (stance, is_applied) {
            (Stance::Accepts | Stance::Doubts, Some(true)) => Stance::Commits,
            // An unknown one that is accepted by others may be on its way here, until acceptances do not count.
            (Stance::Doubts, Some(false) | None) | (Stance::Accepts, Some(false)) => Stance::Refuses,
            (Stance::Accepts, None) | (Stance::Commits | Stance::Refuses, _) => return,
        };
        self.outbox.push_back((from, ParameterVote { transaction, stance: answer }));
    }

    /// Takes the transaction that is due, if all have accepted.
    fn take_due(&mut self, now: Duration) -> Option<Current> {
        self.advance(now);
        let is_due = |current: &mut Current| {
            current.agreement.is_committed() && now >= current.agreement.times().apply_at
        };
        self.current.take_if(is_due)
    }
}

/// The application that takes part in a transaction.
#[derive(Clone, Copy, Debug)]
pub struct OwnPart {
    /// Its TID as bits.
    pub tid: u64,
    /// Whether it has a loop with ticks, at which values are applied.
    pub has_ticks: bool,
}

impl<T> Tuner<T> {
    /// Takes part in a transaction: checks the values, holds them, and accepts. `sent` is the time at which the
    /// message was sent, with its maximum error; `None` if it is unknown. Repeated for the same transaction it returns
    /// its state.
    ///
    /// # Errors
    /// The values are illegal, or the transaction cannot be agreed on. Nothing is held.
    pub fn prepare(
        &mut self,
        transaction: &ParameterTransaction,
        own: OwnPart,
        sent: Option<(Duration, Duration)>,
        now: Duration,
    ) -> Result<ParameterOutcome, ParameterError> {
        self.transactions.advance(now);
        if let Some(known) = self.transactions.outcome_of(transaction.id) {
            return Ok(known);
        }
        if self.transactions.holds() {
            return Err(ParameterError::Held);
        }
        let tids: BTreeSet<u64> = transaction.participants.iter().map(|one| one.tid).collect();
        let are_legal = tids.len() == transaction.participants.len() && tids.len() <= PARTICIPANTS_MAX;
        if !are_legal || !tids.contains(&own.tid) {
            return Err(ParameterError::Participants);
        }
        let (sent, bound) = sent.ok_or(ParameterError::UnknownClock)?;
        let times = times(transaction, sent, now)?;
        if bound > Duration::from_nanos(transaction.lead_ns) / CLOCK_SHARE {
            return Err(ParameterError::UnknownClock);
        }
        if now >= times.decide_by {
            return Err(ParameterError::TooLate);
        }
        let values = self.check(&transaction.values, own.has_ticks)?;
        let agreement = Agreement::new(transaction, own.tid, times, now, &mut self.transactions.outbox);
        self.transactions.current =
            Some(Current { agreement, values, bound, is_holding: true, apply_at: times.apply_at });
        let held = self.transactions.outcome_of(transaction.id);
        Ok(held.unwrap_or_else(|| refused(&ParameterError::UnknownTransaction)))
    }

    /// Returns the outcome of a transaction in which this incarnation took part: [`ParameterOutcome::Held`] until it
    /// is known.
    pub fn outcome_of(&mut self, id: TransactionId, now: Duration) -> ParameterOutcome {
        self.transactions.advance(now);
        self.transactions.outcome_of(id).unwrap_or_else(|| refused(&ParameterError::UnknownTransaction))
    }

    /// Handles a message of the application at `from`, its TID as bits. One that is no participant changes nothing.
    /// Returns whether a kept parameter has another value after a restart.
    pub fn on_vote(&mut self, now: Duration, from: u64, vote: ParameterVote) -> bool {
        self.transactions.on_vote(now, from, vote);
        self.keep_agreed()
    }

    /// Gives kept parameters their agreed values for a restart: the others apply theirs also if this application is
    /// killed before its tick. Returns whether one changes.
    pub(super) fn keep_agreed(&mut self) -> bool {
        let agreed = self.transactions.agreed().into_iter().flatten();
        let mut has_changed = false;
        for &(index, bits) in agreed {
            let is_kept = self.set.descriptors().get(index).is_some_and(|descriptor| descriptor.keep);
            if let Some(cell) = self.set.cell(index).filter(|cell| is_kept && cell.kept() != bits) {
                cell.set_kept(bits);
                has_changed = true;
            }
        }
        has_changed
    }

    /// Returns the next message to another participant: the bits of its TID, and the message. Call it after each other
    /// call until it returns `None`.
    pub fn take_vote(&mut self) -> Option<(u64, ParameterVote)> {
        self.transactions.outbox.pop_front()
    }

    /// Returns the transaction that was applied after its stated time because its result came late, once.
    pub const fn take_late(&mut self) -> Option<TransactionId> {
        self.transactions.late.take()
    }

    /// Takes the steps of the agreement that are due.
    pub(super) fn advance_transaction(&mut self, now: Duration) {
        self.transactions.advance(now);
    }

    /// Applies the values of a transaction at or after its stated time.
    pub(super) fn apply_transaction(&mut self, tick: u64, now: Duration) {
        let Some(Current { agreement, values, is_holding, .. }) = self.transactions.take_due(now) else {
            return;
        };
        let outcome = match self.apply(Some(values)) {
            Ok(values) => ParameterOutcome::Applied { tick, at_ns: nanos(now), values },
            Err(why) => refused(&why),
        };
        if !is_holding {
            self.transactions.late = Some(agreement.id());
        }
        self.transactions.conclude(agreement.id(), outcome);
    }
}

/// Returns the times of a transaction on this clock. Its message was sent at `sent`.
fn times(transaction: &ParameterTransaction, sent: Duration, now: Duration) -> Result<Times, ParameterError> {
    let lead = Duration::from_nanos(transaction.lead_ns);
    let applies_after = Duration::from_nanos(transaction.applies_after_ns);
    if !(LEAD_MIN..=LEAD_MAX).contains(&lead) || applies_after > lead {
        return Err(ParameterError::Lead);
    }
    let apply_at = sent.saturating_add(applies_after);
    // The sender states the time of sending. A wrong one must not hold the parameters for longer.
    if apply_at.saturating_sub(now) > LEAD_MAX {
        return Err(ParameterError::Lead);
    }
    Ok(Times { decide_by: apply_at.saturating_sub(lead / 2), apply_at })
}
