//! Readiness: an actor is ready when each of its sub-tasks has reached its intended point.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

/// Says once that an actor is ready, when all its parts are.
///
/// The paper's section 6: a layer may not mark itself as started before all of its threads have reached the intended
/// point of execution. Each sub-task owns one [`ReadyPart`]; the last one that is reached speaks for all.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Drive;
///
/// impl Actor for Drive {
///     type Context = AppContext<Self>;
///     fn started(&mut self, ctx: &mut Self::Context) {
///         let Some(gate) = ctx.hold_ready() else { return };
///         // Ready when both the encoder and the brake have answered.
///         let [encoder, brake] = gate.parts();
///         std::thread::spawn(move || encoder.reached());
///         std::thread::spawn(move || brake.reached());
///     }
/// }
/// ```
pub struct ReadyGate {
    say: Box<dyn FnOnce() + Send>,
}

impl std::fmt::Debug for ReadyGate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReadyGate")
    }
}

impl ReadyGate {
    /// A gate that calls `say` when it opens.
    pub fn new(say: impl FnOnce() + Send + 'static) -> Self {
        Self { say: Box::new(say) }
    }

    /// The actor is ready, having no parts to wait for.
    pub fn reached(self) {
        (self.say)();
    }

    /// One part for each sub-task; the gate opens when all `N` are reached.
    #[must_use]
    pub fn parts<const N: usize>(self) -> [ReadyPart; N] {
        let shared = Arc::new(Parts { left: AtomicUsize::new(N), gate: std::sync::Mutex::new(Some(self)) });
        std::array::from_fn(|_| ReadyPart(shared.clone()))
    }
}

struct Parts {
    left: AtomicUsize,
    gate: std::sync::Mutex<Option<ReadyGate>>,
}

/// One sub-task's share of a [`ReadyGate`].
pub struct ReadyPart(Arc<Parts>);

impl std::fmt::Debug for ReadyPart {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReadyPart")
    }
}

impl ReadyPart {
    /// This sub-task has reached its intended point.
    pub fn reached(self) {
        // SYNC: AcqRel, so that whoever sees the count at zero also sees what the other parts did before.
        if self.0.left.fetch_sub(1, Ordering::AcqRel) == 1
            && let Some(gate) = crate::post::lock(&self.0.gate).take()
        {
            gate.reached();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gate_opens_when_the_last_part_is_reached_and_not_before() {
        let opened = Arc::new(AtomicUsize::new(0));
        let counter = opened.clone();
        let [first, second] = ReadyGate::new(move || {
            counter.fetch_add(1, Ordering::Relaxed);
        })
        .parts();
        first.reached();
        assert_eq!(opened.load(Ordering::Relaxed), 0);
        second.reached();
        assert_eq!(opened.load(Ordering::Relaxed), 1);
    }
}
