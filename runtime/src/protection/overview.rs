//! The states of the outputs of this process, for reports of a node.
//!
//! A report never takes the lock of an output. A thread of low priority that held it could keep the thread
//! `safe-output` from making the output safe. So each output publishes its state as a number.

use std::{
    collections::BTreeSet,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU8, Ordering},
    },
    time::Duration,
};

use super::{Cause, DataId, Protection, State, safe_output::WatchState, stop_latch::StopLatch};
use crate::{lock, tid::NodeAddress};

/// Maximum number of outputs in the list. Further ones work, and are in no report.
const OUTPUTS_MAX: usize = 1_024;
/// All causes. A published state is the place of its cause here, or their number.
const CAUSES: [Cause; 9] = [
    Cause::NotArmed,
    Cause::Silent,
    Cause::TooMuchLost,
    Cause::TooManyBad,
    Cause::Restarted,
    Cause::Slept,
    Cause::Tripped,
    Cause::Dropped,
    Cause::Stopped,
];

/// All outputs that are not dropped yet.
static OUTPUTS: Mutex<Vec<(DataId, Weak<WatchState>)>> = Mutex::new(Vec::new());

/// The state of an output, readable without its lock.
pub(super) struct PublishedState(AtomicU8);

impl PublishedState {
    /// Returns the state of a new output.
    pub(super) const fn not_armed() -> Self {
        Self(AtomicU8::new(code(State::Safe(Cause::NotArmed))))
    }

    /// Publishes a state.
    ///
    /// SYNC: the thread `safe-output` reads it in [`is_live`](Self::is_live), after a stop or an arm has woken it.
    pub(super) fn set(&self, state: State) {
        self.0.store(code(state), Ordering::Release);
    }

    /// Returns whether the output was live when its state was published last.
    pub(super) fn is_live(&self) -> bool {
        self.0.load(Ordering::Acquire) == code(State::Live)
    }

    fn get(&self) -> State {
        let code = self.0.load(Ordering::Relaxed);
        CAUSES.get(usize::from(code)).map_or(State::Live, |cause| State::Safe(*cause))
    }
}

const fn code(state: State) -> u8 {
    match state {
        State::Safe(Cause::NotArmed) => 0,
        State::Safe(Cause::Silent) => 1,
        State::Safe(Cause::TooMuchLost) => 2,
        State::Safe(Cause::TooManyBad) => 3,
        State::Safe(Cause::Restarted) => 4,
        State::Safe(Cause::Slept) => 5,
        State::Safe(Cause::Tripped) => 6,
        State::Safe(Cause::Dropped) => 7,
        State::Safe(Cause::Stopped) => 8,
        State::Live => 9,
    }
}

/// The state of an output at some moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputState {
    /// The sender, the receiver and the type of its commands.
    pub data_id: DataId,
    /// Whether commands reach it, or why not.
    pub state: State,
    /// Whether its safe function has failed and is retried: it may still be live.
    pub is_safe_failed: bool,
    /// The limits of its commands.
    pub protection: Protection,
    /// Time from the last command until the output was safe, in a dry run; `None`: it had none.
    pub measured: Option<Duration>,
}

/// The outputs that one stop concerns, for its report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoppedOutputs {
    /// Their number.
    pub outputs: u32,
    /// Time after the last command of a stopped sender within which all of them are safe: an age of a command, and a
    /// silence after it.
    pub watchdog: Duration,
    /// The nodes of the senders of their commands.
    pub sources: BTreeSet<NodeAddress>,
}

/// Returns the outputs in this process that obey this stop.
#[must_use]
pub fn stopped_outputs(stop: &Arc<StopLatch>) -> StoppedOutputs {
    let outputs = lock(&OUTPUTS);
    let own = outputs.iter().filter_map(|(data_id, watch)| Some((data_id, watch.upgrade()?)));
    let mut found = StoppedOutputs::default();
    for (data_id, watch) in own.filter(|(_, watch)| Arc::ptr_eq(&watch.stop, stop)) {
        found.outputs += 1;
        found.watchdog = found.watchdog.max(watch.protection.age_max + watch.protection.within);
        found.sources.insert(data_id.source.node);
    }
    found
}

/// Adds an output. It leaves the list when it is dropped.
pub(super) fn add(data_id: DataId, watch: &Arc<WatchState>) {
    let mut outputs = lock(&OUTPUTS);
    outputs.retain(|(_, watch)| watch.strong_count() > 0);
    if outputs.len() < OUTPUTS_MAX {
        outputs.push((data_id, Arc::downgrade(watch)));
    }
}

/// Returns the states of this process's outputs on the host's clock, in the order of their creation. Outputs without an
/// owner are left out once they are safe.
#[must_use]
pub fn outputs() -> Vec<OutputState> {
    let outputs = lock(&OUTPUTS);
    let living = outputs.iter().filter_map(|(data_id, watch)| Some((*data_id, watch.upgrade()?)));
    let is_over = |watch: &WatchState| {
        watch.is_orphan.load(Ordering::Acquire) && !watch.needs_retry.load(Ordering::Acquire)
    };
    let state = |(data_id, watch): (DataId, Arc<WatchState>)| OutputState {
        data_id,
        state: watch.published.get(),
        is_safe_failed: watch.needs_retry.load(Ordering::Acquire),
        protection: watch.protection,
        measured: match watch.measured_ns.load(Ordering::Relaxed) {
            0 => None,
            nanos => Some(Duration::from_nanos(nanos)),
        },
    };
    living.filter(|(_, watch)| !is_over(watch)).map(state).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        protection::Guard,
        tid::{AppAddress, NodeAddress, Tid},
        wire::Payload,
    };

    #[derive(serde::Serialize, serde::Deserialize)]
    struct Torque;

    impl Payload for Torque {
        const NAME: &'static str = "test.overview.torque";
        const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
    }

    fn states() -> Vec<OutputState> {
        // Other tests of this process have outputs, too.
        outputs().into_iter().filter(|output| output.data_id.name == Torque::NAME).collect()
    }

    #[test]
    fn each_state_is_published_as_it_is() {
        let published = PublishedState::not_armed();
        assert_eq!(published.get(), State::Safe(Cause::NotArmed));
        for state in CAUSES.map(State::Safe).into_iter().chain([State::Live]) {
            published.set(state);
            assert_eq!(published.get(), state);
        }
    }

    #[test]
    fn output_is_listed_until_its_guard_is_dropped() {
        let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
        let data_id = DataId::of::<Torque>(tid(1), tid(2));
        let guard = Guard::new::<Torque>(tid(1), tid(2), (), |(), _| {}).expect("there is the thread");
        let protection = Protection::of_period(Duration::from_millis(20));
        let listed = |cause| {
            let state = State::Safe(cause);
            vec![OutputState { data_id, state, is_safe_failed: false, protection, measured: None }]
        };
        assert_eq!(states(), listed(Cause::NotArmed));
        guard.trip();
        assert_eq!(guard.state(), states()[0].state, "the list agrees with the guard");
        drop(guard);
        assert_eq!(states(), []);
    }
}
