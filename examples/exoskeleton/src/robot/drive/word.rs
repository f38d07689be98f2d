//! What central says, behind the guard that lets nothing else through, and who may open that.

use std::io;

use sinew::prelude::{AppContext, Delivery, Tid, Time};
use sinew::protection::{Guard, State};

use super::lookout::Watch;
use super::suspicion::Suspicion;
use super::{Drive, SILENCE_MAX};
use crate::message::{DriveState, GaitState};
use crate::robot::device::Damper;
use crate::robot::edges::Arm;

/// What central says.
pub(super) struct Word {
    /// Whose word it is.
    pub(super) central: Tid,
    pub(super) guard: Guard<Output>,
    /// Lets through what asks to open that one: there only while it is shut, so that nothing counts that was sent for another time.
    arms: Option<Guard<()>>,
    suspicion: Suspicion,
}

/// What is taken away as soon as central's word does not count: by whoever notices first.
pub(super) struct Output {
    pub(super) word: Option<GaitState>,
    device: Box<dyn Damper>,
    /// Whether the device was told to give a torque: one that gives nothing on purpose is left as it is.
    pub(super) gives: bool,
    pub(super) again: Watch,
}

/// What came of an [`Arm`].
pub(super) enum Armed {
    /// Central's word counts from now on.
    Now,
    /// It counted before.
    Before,
    /// It does not count.
    Refused,
}

impl Output {
    pub(super) fn new(device: Box<dyn Damper>, again: Watch) -> Self {
        Self { word: None, device, gives: false, again }
    }

    pub(super) fn make_safe(&mut self) {
        self.word = None;
        if std::mem::take(&mut self.gives) {
            self.device.damp(Time::now(), DriveState::Safe);
            // One may be lost, and the drive's thread may hang.
            self.again.damps();
        }
    }
}

impl Word {
    pub(super) fn new(central: Tid, guard: Guard<Output>) -> Self {
        Self { central, guard, arms: None, suspicion: Suspicion::default() }
    }

    /// Whether it does not count.
    pub(super) fn is_shut(&self) -> bool {
        self.guard.state() != State::Live
    }

    /// Whether somebody meddles with it.
    pub(super) const fn is_suspect(&self) -> bool {
        self.suspicion.is_there()
    }

    /// Takes in what the guard has counted, and hears who asks to open it while it is shut.
    ///
    /// # Errors
    /// What asks cannot be guarded, so that nobody is heard; it is tried again in the next look.
    pub(super) fn look(&mut self, context: &mut AppContext<Drive>) -> io::Result<()> {
        let is_shut = self.is_shut();
        self.suspicion.note(&self.guard.tally(), !is_shut);
        if !is_shut {
            self.arms = None;
        } else if let Some(arms) = &self.arms {
            // It moves nothing by itself. Refused until one has come, against which the next can be counted.
            let _ = arms.arm();
        } else {
            self.arms = Some(context.guard::<Arm, _>(self.central, (), |_, _| {})?);
        }
        Ok(())
    }

    /// Lets central's word count again, if that is right. `state` is the drive's.
    pub(super) fn arm(&mut self, arm: &Delivery<Arm>, state: DriveState) -> Armed {
        if !self.is_shut() {
            return Armed::Before;
        }
        // In WALK the tick is still to come that makes the drive safe, and what central meant long ago may not be so any more. Refused, too,
        // until eight good words have come in a row.
        // So is one that was sent before central knew that somebody meddles.
        self.suspicion.note(&self.guard.tally(), false);
        let is_known = arm.suspect || !self.suspicion.is_there();
        let is_old = arm.is_older_than(SILENCE_MAX);
        if state == DriveState::Walk || is_old || !is_known || self.guard.arm().is_err() {
            return Armed::Refused;
        }
        self.suspicion.forget();
        // What else is on its way answers what was asked before.
        self.arms = None;
        // A ramp to zero may be under way.
        let _ = self.guard.apply(|output| output.gives = true);
        Armed::Now
    }
}
