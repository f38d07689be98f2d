//! Stages sets of values, applies them at a tick, moves values with their slopes, takes part in transactions.

#[cfg(test)]
mod tests;
mod transactions;

use std::{
    collections::{BTreeSet, VecDeque},
    sync::Arc,
    time::Duration,
};

pub use self::transactions::OwnPart;
use self::transactions::Transactions;
use crate::{
    Domain, NamedValue, PARTICIPANTS_MAX, ParameterList, ParameterOutcome, ParameterReport, Parameters,
    SetParameters, Value, descriptor::Descriptor,
};

/// Maximum number of sets that wait for a tick. Further ones are refused.
pub const STAGED_MAX: usize = 16;
/// Maximum number of applied sets that can be undone. The oldest one is forgotten.
pub const UNDO_MAX: usize = 16;
/// Time in which a tick must come. A set that waits longer is refused, and is not applied later.
pub const TICK_WITHIN: Duration = Duration::from_secs(1);
/// Maximum number of periods for which one tick moves a value with a slope: that tick and a missed one. After a longer
/// stall the value would jump.
const PERIODS_PER_TICK_MAX: u32 = 2;
/// Minimum similarity of the name in a suggestion.
const SIMILAR: f64 = 0.8;
/// Maximum characters of a name that are compared or shown.
const NAME_SHOWN: usize = 64;

/// The reason why a set of values is refused. No parameter has changed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ParameterError {
    /// The application has no parameter of this name. The caller is at fault.
    #[error("the application has no parameter '{name}'{nearest}; `sinew param list` shows all")]
    Unknown {
        /// The name, at most 64 characters of it.
        name: String,
        /// The nearest name, as a part of the sentence.
        nearest: String,
    },
    /// A value is outside of its range. The caller is at fault.
    #[error("{name} = {value}{unit} is outside {min} to {max}{unit}")]
    OutOfRange {
        /// The parameter.
        name: &'static str,
        /// The value.
        value: Value,
        /// The least legal value.
        min: Value,
        /// The greatest legal value.
        max: Value,
        /// The unit behind a space; empty for a share or a count.
        unit: String,
    },
    /// A value has another type than its parameter. The caller is at fault.
    #[error("{name} = {value} has the wrong type: {name} takes {legal}")]
    WrongType {
        /// The parameter.
        name: &'static str,
        /// The value.
        value: Value,
        /// The legal values.
        legal: String,
    },
    /// A parameter stands twice in one set. The caller is at fault.
    #[error("{0} stands twice in the set: give it one value")]
    Twice(&'static str),
    /// The set has no values. The caller is at fault.
    #[error("the set has no values: name at least one parameter")]
    Empty,
    /// As many sets wait for the next tick as may wait. The caller sends too often, or no tick comes.
    #[error("{STAGED_MAX} sets wait for the next tick already: send this one again, and less often")]
    Full,
    /// No tick came in time.
    #[error(
        "no tick came within 1 s or before the sender's deadline: look whether the application is paused or hangs (`sinew apps`, `sinew tree`)"
    )]
    NoTick,
    /// There is nothing to undo.
    #[error("there is no set to undo: the last {UNDO_MAX} since the application's start are kept")]
    NothingToUndo,
    /// A parameter with a slope moves at ticks, and the application has none.
    #[error(
        "{0} moves with a slope at ticks, and the application has no periodic timer: start one by `ctx.every`, or declare it without a slope"
    )]
    SlopeWithoutTicks(&'static str),
    /// A transaction holds the parameters until its stated time. The caller sends too often.
    #[error("a transaction holds the parameters until its stated time: send this set again after it")]
    Held,
    /// A transaction names this application not at all or twice, or too many ones. The caller is at fault.
    #[error(
        "a transaction names 1 to {PARTICIPANTS_MAX} applications, each once, and the receiver among them"
    )]
    Participants,
    /// The clock of the sender's host is not measured well enough: its error is above an eighth of the lead.
    #[error(
        "the clock of the sender's host is not known here within an eighth of the lead: send the transaction again in some seconds, or with a longer lead"
    )]
    UnknownClock,
    /// The lead of a transaction is outside of its range. The caller is at fault.
    #[error("the stated time of a transaction is 20 ms to 2 s after its begin")]
    Lead,
    /// A transaction arrived when acceptances did not count any more.
    #[error(
        "it arrived after half of its lead, when acceptances do not count any more: give it a longer lead"
    )]
    TooLate,
    /// Not all participants have accepted a transaction in time, as far as is known here.
    #[error(
        "nothing was applied at the stated time, as no acceptance of {missing} was known. If another application has applied its values, these ones follow as soon as it can be reached within 10 s, if no other set comes before"
    )]
    NotAgreed {
        /// The names of the others.
        missing: String,
    },
    /// The application has not taken part in this transaction since its start.
    #[error("the application knows no such transaction: it was started after it, or has had 16 others since")]
    UnknownTransaction,
}

/// The values of a set, by the index of the parameter.
type Values = Vec<(usize, u64)>;

/// A set that waits for a tick.
struct Staged<T> {
    ticket: T,
    /// `None`: undo the last set.
    values: Option<Values>,
    until: Duration,
}

/// The only writer of the parameters of one incarnation of an application. Pure: times are arguments, counted from the
/// origin of the application's clock. `T` identifies a set to the caller until its outcome is known.
pub struct Tuner<T> {
    set: Arc<dyn Parameters>,
    staged: VecDeque<Staged<T>>,
    /// The former targets of the applied sets, the last one at the end.
    former: VecDeque<Values>,
    /// When slopes were last advanced.
    moved: Duration,
    /// Whether a value has not reached its target.
    is_moving: bool,
    /// Whether this tick has changed a kept parameter.
    has_kept_change: bool,
    transactions: Transactions,
}

impl<T> Tuner<T> {
    /// Creates the tuner of a new incarnation. Parameters that are not kept get their defaults.
    pub fn new(set: Arc<dyn Parameters>, now: Duration) -> Self {
        for (index, descriptor) in set.descriptors().iter().enumerate() {
            let Some(cell) = set.cell(index) else { continue };
            let bits = if descriptor.keep { cell.kept() } else { bits_of(descriptor.default()) };
            cell.set_target(bits);
            // A kept value of the former incarnation may have been on its way: it does not jump.
            if !descriptor.keep || descriptor.slope_per_s().is_none() {
                cell.set_value(bits);
            }
        }
        let mut tuner = Self {
            set,
            staged: VecDeque::new(),
            former: VecDeque::new(),
            moved: now,
            is_moving: true,
            has_kept_change: false,
            transactions: Transactions::default(),
        };
        tuner.advance(Duration::ZERO);
        tuner
    }

    /// Checks a set, and stages it for the next tick.
    ///
    /// # Errors
    /// Returns the ticket and the reason; nothing was staged.
    pub fn stage(
        &mut self,
        set: &SetParameters,
        (ticket, until): (T, Duration),
        has_ticks: bool,
    ) -> Result<(), (T, ParameterError)> {
        if self.staged.len() >= STAGED_MAX {
            return Err((ticket, ParameterError::Full));
        }
        if self.transactions.holds() {
            return Err((ticket, ParameterError::Held));
        }
        let values = match set {
            // These are no sets to stage: see `prepare` and `outcome_of`.
            SetParameters::Prepare(_) | SetParameters::Conclude(_) => {
                return Err((ticket, ParameterError::Participants));
            }
            SetParameters::Undo => None,
            SetParameters::Values(values) => match self.check(values, has_ticks) {
                Ok(values) => Some(values),
                Err(why) => return Err((ticket, why)),
            },
        };
        if values.is_none()
            && !has_ticks
            && let Some(name) = self.undone_slope()
        {
            return Err((ticket, ParameterError::SlopeWithoutTicks(name)));
        }
        self.transactions.supersede();
        self.staged.push_back(Staged { ticket, values, until });
        Ok(())
    }

    /// Applies the sets that wait, in the order of their arrival, and moves values with a slope by the time since the
    /// last call, at most two periods. Without a timer `period` is zero, and no value moves. `done` gets the outcome of
    /// each set. Returns whether a kept parameter has a new value or target.
    pub fn tick(
        &mut self,
        (tick, period): (u64, Duration),
        now: Duration,
        mut done: impl FnMut(T, ParameterOutcome),
    ) -> bool {
        let since = now.saturating_sub(self.moved).min(period.saturating_mul(PERIODS_PER_TICK_MAX));
        self.moved = now;
        self.expire(now, &mut done);
        self.has_kept_change = false;
        while let Some(Staged { ticket, values, .. }) = self.staged.pop_front() {
            let outcome = match self.apply(values) {
                Ok(values) => ParameterOutcome::Applied { tick, at_ns: nanos(now), values },
                Err(why) => refused(&why),
            };
            done(ticket, outcome);
        }
        self.apply_transaction(tick, now);
        self.has_kept_change |= self.keep_agreed();
        if self.is_moving {
            self.advance(since);
        }
        self.has_kept_change
    }

    /// Refuses the sets that have waited too long, and takes the steps of a transaction that are due.
    pub fn expire(&mut self, now: Duration, mut done: impl FnMut(T, ParameterOutcome)) {
        self.advance_transaction(now);
        // In the order of arrival; deadlines differ, as each sender has its own.
        for _ in 0..self.staged.len() {
            match self.staged.pop_front() {
                Some(late) if late.until <= now => done(late.ticket, refused(&ParameterError::NoTick)),
                Some(waiting) => self.staged.push_back(waiting),
                None => {}
            }
        }
    }

    /// Resumes after a pause: values with a slope did not move in it.
    pub const fn resume(&mut self, now: Duration) {
        self.moved = now;
    }

    /// Returns the earliest time at which a set that waits is refused, or a transaction has a step to take.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Duration> {
        self.staged.iter().map(|staged| staged.until).chain(self.transactions.next_wake()).min()
    }

    /// Returns whether no set waits, no value moves and no transaction is open.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.staged.is_empty() && !self.is_moving && self.transactions.is_idle()
    }

    /// Returns all parameters and their values.
    #[must_use]
    pub fn list(&self, has_ticks: bool) -> ParameterList {
        let parameters = self.set.descriptors().iter().enumerate().filter_map(|(index, descriptor)| {
            let cell = self.set.cell(index)?;
            let range = descriptor.range();
            Some(ParameterReport {
                name: descriptor.name.to_owned(),
                description: descriptor.description(),
                unit: descriptor.unit.to_owned(),
                value: descriptor.value_of(cell.value()),
                target: descriptor.value_of(cell.target()),
                default: descriptor.default(),
                min: range.map(|(min, _)| min),
                max: range.map(|(_, max)| max),
                slope_per_s: descriptor.slope_per_s(),
                keep: descriptor.keep,
            })
        });
        let undoable = u32::try_from(self.former.len()).unwrap_or(u32::MAX);
        ParameterList { parameters: parameters.collect(), has_ticks, undoable }
    }

    /// Returns the first parameter with a slope of the set that an undo would take back.
    fn undone_slope(&self) -> Option<&'static str> {
        let descriptors = self.set.descriptors();
        let mut last = self.former.back()?.iter().filter_map(|(index, _)| descriptors.get(*index));
        last.find(|descriptor| descriptor.slope_per_s().is_some()).map(|descriptor| descriptor.name)
    }

    /// Checks all values of a set.
    fn check(&self, values: &[NamedValue], has_ticks: bool) -> Result<Values, ParameterError> {
        if values.is_empty() {
            return Err(ParameterError::Empty);
        }
        let descriptors = self.set.descriptors();
        let (mut seen, mut checked) = (BTreeSet::new(), Values::new());
        for NamedValue { name, value } in values {
            // At most one value of each parameter passes, so the loop ends early for a longer set.
            let index = descriptors.iter().position(|descriptor| descriptor.name == name);
            let index = index.ok_or_else(|| unknown(name, descriptors))?;
            let descriptor = &descriptors[index];
            if !seen.insert(index) {
                return Err(ParameterError::Twice(descriptor.name));
            }
            if descriptor.slope_per_s().is_some() && !has_ticks {
                return Err(ParameterError::SlopeWithoutTicks(descriptor.name));
            }
            checked.push((index, legal_bits(descriptor, *value)?));
        }
        Ok(checked)
    }

    /// Applies a set, or undoes the last one.
    fn apply(&mut self, values: Option<Values>) -> Result<Vec<NamedValue>, ParameterError> {
        let is_undo = values.is_none();
        let undone = || self.former.pop_back().ok_or(ParameterError::NothingToUndo);
        let values = values.map_or_else(undone, Ok)?;
        let (mut former, mut applied) = (Values::new(), Vec::new());
        for (index, bits) in values {
            let Some((descriptor, cell)) = self.set.descriptors().get(index).zip(self.set.cell(index)) else {
                continue;
            };
            former.push((index, cell.target()));
            cell.set_target(bits);
            self.has_kept_change |= descriptor.keep;
            match descriptor.slope_per_s() {
                Some(_) => self.is_moving = true,
                None => cell.set_value(bits),
            }
            applied.push(NamedValue { name: descriptor.name.to_owned(), value: descriptor.value_of(bits) });
        }
        if !is_undo {
            if self.former.len() >= UNDO_MAX {
                self.former.pop_front();
            }
            self.former.push_back(former);
        }
        Ok(applied)
    }

    /// Moves the values with a slope for this time.
    fn advance(&mut self, since: Duration) {
        self.is_moving = false;
        for (index, descriptor) in self.set.descriptors().iter().enumerate() {
            let Some((slope, cell)) = descriptor.slope_per_s().zip(self.set.cell(index)) else { continue };
            let (value, target) = (f64::from_bits(cell.value()), f64::from_bits(cell.target()));
            let step = slope * since.as_secs_f64();
            let next = moved(value, target, step);
            cell.set_value(next.to_bits());
            self.is_moving |= next != target;
        }
    }
}

/// Returns `value` moved to `target` by at most `step`.
fn moved(value: f64, target: f64, step: f64) -> f64 {
    let way = target - value;
    // A range may be wider than a number can express.
    if way.abs() <= step { target } else { value + step.copysign(way) }
}

/// Returns the outcome of a refused set.
fn refused(why: &ParameterError) -> ParameterOutcome {
    ParameterOutcome::Refused { why: why.to_string() }
}

impl From<&ParameterError> for ParameterOutcome {
    fn from(why: &ParameterError) -> Self {
        refused(why)
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

fn bits_of(value: Value) -> u64 {
    match value {
        Value::Number(number) => number.to_bits(),
        Value::Integer(integer) => integer.cast_unsigned(),
        Value::Flag(flag) => flag.into(),
    }
}

/// Returns the bits of a value that its parameter may have.
pub(crate) fn legal_bits(descriptor: &Descriptor, value: Value) -> Result<u64, ParameterError> {
    let name = descriptor.name;
    let unit =
        if ["", "1"].contains(&descriptor.unit) { String::new() } else { format!(" {}", descriptor.unit) };
    let wrong_type = |legal: String| ParameterError::WrongType { name, value, legal };
    let out_of_range = |min, max| ParameterError::OutOfRange { name, value, min, max, unit: unit.clone() };
    match descriptor.domain {
        Domain::Number { min, max, .. } => {
            let number = value.as_number();
            let number =
                number.ok_or_else(|| wrong_type(format!("a number from {min:?} to {max:?}{unit}")))?;
            // NaN is in no range.
            let is_legal = (min..=max).contains(&number);
            is_legal
                .then(|| number.to_bits())
                .ok_or_else(|| out_of_range(Value::Number(min), Value::Number(max)))
        }
        Domain::Integer { min, max, .. } => {
            let Value::Integer(integer) = value else {
                return Err(wrong_type(format!("a whole number from {min} to {max}{unit}")));
            };
            let is_legal = (min..=max).contains(&integer);
            let bits = is_legal.then(|| integer.cast_unsigned());
            bits.ok_or_else(|| out_of_range(Value::Integer(min), Value::Integer(max)))
        }
        Domain::Flag { .. } => match value {
            Value::Flag(flag) => Ok(flag.into()),
            Value::Number(_) | Value::Integer(_) => Err(wrong_type("true or false".to_owned())),
        },
    }
}

/// Returns the error for a name that no parameter has.
pub(crate) fn unknown(name: &str, descriptors: &[Descriptor]) -> ParameterError {
    let name: String = name.chars().take(NAME_SHOWN).collect();
    let similarity = |other: &Descriptor| strsim::jaro_winkler(&name, other.name);
    let nearest = descriptors.iter().map(|other| (similarity(other), other.name));
    let nearest = nearest.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(similarity, _)| *similarity >= SIMILAR);
    let nearest = nearest.map_or_else(String::new, |(_, other)| format!("; the nearest name is '{other}'"));
    ParameterError::Unknown { name, nearest }
}
