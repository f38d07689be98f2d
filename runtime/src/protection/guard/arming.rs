//! Arming an output, and the acknowledgement of a stop before that.

use super::{ArmError, Cause, Guard, wake};

impl<O: Send + 'static> Guard<O> {
    /// Arms the output: from now on commands pass. Call it after a check that this is safe; nothing arms an
    /// output automatically.
    ///
    /// # Errors
    /// Too few good messages have arrived, the output could not be made safe, or a stop is in force or not
    /// [acknowledged](Self::acknowledge_stop).
    pub fn arm(&self) -> Result<(), ArmError> {
        let shared = self.shared();
        shared.with(|inner| {
            shared.retry_safe(inner, shared.clock.now());
            if inner.retry.is_some() {
                return Err(ArmError::SafeFails);
            }
            if !shared.watch.may_arm() {
                // Received messages do not count after a stop.
                shared.decide_locked(inner, |_, _| ());
                return Err(ArmError::Stopped);
            }
            let is_released = self.is_released();
            shared.decide_locked(inner, |receiver, now| {
                if is_released {
                    // Received messages do not count: the guard was released while the caller was about to arm it.
                    receiver.trip(Cause::Dropped);
                }
                receiver.arm(now)
            })?;
            // The output is live: its safe function is not called without a cause.
            inner.dry_run = None;
            // SYNC: after the output was counted as live. A stop that was pressed meanwhile has seen that count, or is
            // seen here.
            if shared.watch.must_stop() {
                shared.decide_locked(inner, |_, _| ());
                return Err(ArmError::Stopped);
            }
            Ok(())
        })?;
        // The thread sleeps without a deadline, as there was none.
        wake();
        Ok(())
    }

    /// Acknowledges that a stop was pressed and released: from now on the output can be armed again. It moves nothing.
    ///
    /// Call it on the order of a person, or of the application that coordinates the start. An application that
    /// calls it by itself, as soon as the stop is released, makes the robot move by the release. The outputs that
    /// the application makes later are acknowledged by it, too; without it they cannot be armed, even if they were
    /// made after the release.
    ///
    /// # Errors
    /// The stop is still in force ([`ArmError::Stopped`]), or the output could not be made safe.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::protection::{ArmError, Guard};
    ///
    /// /// The person has pressed "start" again.
    /// fn start_again<O: Send>(guard: &Guard<O>) -> Result<(), ArmError> {
    ///     guard.acknowledge_stop() // and `arm`, when the next good commands have come
    /// }
    /// ```
    pub fn acknowledge_stop(&self) -> Result<(), ArmError> {
        let shared = self.shared();
        shared.with(|inner| {
            shared.retry_safe(inner, shared.clock.now());
            // First it becomes safe by the stop that is acknowledged.
            shared.decide_locked(inner, |_, _| ());
            if inner.retry.is_some() {
                return Err(ArmError::SafeFails);
            }
            if shared.watch.acknowledge(shared.data_id.destination) { Ok(()) } else { Err(ArmError::Stopped) }
        })
    }

    /// Returns whether a stop was pressed that is in force, or that was not [acknowledged](Self::acknowledge_stop). The
    /// output is safe then, or becomes so at once.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        self.shared().watch.must_stop()
    }
}
