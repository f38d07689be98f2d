//! Readiness: an actor is ready when each of its sub-tasks has reached its intended point.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

/// Reports once that an actor is ready, when all its parts are.
///
/// The paper's section 6: a layer may not mark itself as started before all of its threads have reached the
/// intended point of execution. Each sub-task owns one [`ReadyPart`]; the last one that is reached opens the
/// gate.
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
    on_ready: Box<dyn FnOnce() + Send>,
}

impl std::fmt::Debug for ReadyGate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReadyGate")
    }
}

impl ReadyGate {
    /// Creates a gate that calls `on_ready` when it opens.
    pub fn new(on_ready: impl FnOnce() + Send + 'static) -> Self {
        Self { on_ready: Box::new(on_ready) }
    }

    /// Opens the gate of an actor without parts.
    pub fn reached(self) {
        (self.on_ready)();
    }

    /// Splits the gate into one part per sub-task; the gate opens when all `N` are reached.
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

/// The part of a [`ReadyGate`] that one sub-task owns.
pub struct ReadyPart(Arc<Parts>);

impl std::fmt::Debug for ReadyPart {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReadyPart")
    }
}

impl ReadyPart {
    /// Marks this sub-task as having reached its intended point.
    pub fn reached(self) {
        // SYNC: AcqRel, so that the thread that sees the count at zero also sees the earlier writes of the other parts.
        if self.0.left.fetch_sub(1, Ordering::AcqRel) == 1
            && let Some(gate) = crate::lock(&self.0.gate).take()
        {
            gate.reached();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gate_opens_only_when_the_last_part_is_reached() {
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
