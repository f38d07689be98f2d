//! A guard without the type of its output.

use std::time::Duration;

use bytes::Bytes;

use crate::{
    protection::{
        DataId,
        envelope::look,
        raw::Reads,
        receiver::{Opened, Verdict},
    },
    time::Time,
};

/// A guard of any output type, as its application's context uses it.
pub(crate) trait Guarded: Send + Sync {
    /// Returns the data ID of the flow.
    fn data_id(&self) -> DataId;
    /// Returns whether the guard has no owner any more.
    fn is_orphan(&self) -> bool;
    /// Makes the output safe: at once, or as soon as its lock is free.
    fn trip(&self);
    /// Checks a message that was opened.
    fn judge(&self, opened: Opened) -> Verdict<()>;
    /// Returns the time that the sender must quote.
    fn echo(&self) -> Time;
    /// Returns the last time that was echoed to the sender.
    fn last_echo(&self) -> Time;
    /// Returns the time between two echoes.
    fn echo_period(&self) -> Duration;
}

impl dyn Guarded {
    /// Checks a message. One that `read` cannot decode is bad. `read` is user code: the output's lock is not
    /// held meanwhile.
    pub(crate) fn take<T>(&self, bytes: &Bytes, read: impl FnOnce(Bytes) -> Option<T>) -> Verdict<T> {
        let (opened, value) = Opened::of(&self.data_id(), bytes, read);
        self.judge(opened).of(value)
    }

    /// Same as `take`, for borrowed memory.
    pub(crate) fn check(&self, sealed: &[u8], reads: Reads) -> Verdict<()> {
        let (opened, _) = Opened::read(look(&self.data_id(), sealed), |payload: &[u8]| {
            reads.is_value(payload).then_some(())
        });
        self.judge(opened)
    }
}
