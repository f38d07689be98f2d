//! Barriers: several applications, on any nodes, go on together, or come up in phases.

use std::{mem::MaybeUninit, time::Duration};

use sinew::barrier::{BarrierError, OnPartyLoss};

use crate::{
    border::{call, present, write},
    message::Endpoint,
    registration::with,
    status::{Fault, Status},
    text::{self, Text},
};

/// For `flags` of `sinew_barrier`: does not wait for the return of a party that is asked for by its name and has failed, was
/// stopped, or whose node is lost. Then `sinew_meet` returns `SINEW_ERROR_PARTY_LOST`.
pub const SINEW_FAIL_ON_LOSS: u32 = 1;
/// For `flags` of `sinew_barrier`: a phase. Whoever has reached it counts until it is unregistered, also while it does something
/// else: an application that is started again goes on at once if the others are there.
pub const SINEW_PHASE: u32 = 2;

const KNOWN_FLAGS: u32 = SINEW_FAIL_ON_LOSS | SINEW_PHASE;

/// A barrier: where several applications, on any nodes, wait for each other. It need not be made, and can be used again and
/// again. Set all of it to zero, then what is wanted. All that meet say the same name and the same parties.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Barrier {
    /// Its name, 1 to 63 bytes; of a phase one word.
    pub name: Text,
    /// Who has to be there: `knee.drive`, `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `3 of *`. At most 64. Whoever waits must
    /// be one of them.
    pub parties: *const Text,
    /// How many.
    pub parties_count: usize,
    /// How long to wait, rounded up to milliseconds. Default: 60 s.
    pub within_ns: u64,
    /// `SINEW_FAIL_ON_LOSS`, `SINEW_PHASE`. Default: neither.
    pub flags: u32,
    /// Zero.
    pub reserved: u32,
}

/// Arrives at a barrier and waits until all parties have, `within_ns` of the barrier at most. `*generation` is how often the barrier
/// has opened then, the same number for all that went on together (of a phase 1); `generation` may be NULL. What comes meanwhile waits
/// to be received. `SINEW_ERROR_NOT_MET`: not all came in time; `SINEW_ERROR_PARTY_LOST`: one was lost and was not to be waited for;
/// the sentence of both says who is missing, and why. `SINEW_ERROR_REFUSED`: this endpoint is none of the parties, or the barrier is
/// none, in words. After any other error it counts as arrived until the barrier's time is over. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_meet(
    endpoint: *mut Endpoint,
    barrier: Option<&Barrier>,
    generation: Option<&mut MaybeUninit<u64>>,
) -> Status {
    call(|| {
        let barrier = present(barrier, "barrier")?.read()?;
        let opened = with(endpoint, |session| session.endpoint().meet(&barrier).map_err(Fault::from))?;
        Ok(generation.map_or(Status::SinewOk, |generation| write(generation, opened)))
    })
}

impl Barrier {
    /// As Rust says it.
    fn read(&self) -> Result<sinew::barrier::Barrier, Fault> {
        if self.flags & !KNOWN_FLAGS != 0 {
            return Err(Fault::argument(format!("`barrier.flags` is {:#x}: no such flags", self.flags)));
        }
        if self.reserved != 0 {
            return Err(Fault::argument(format!("`barrier.reserved` is {}: set it to 0", self.reserved)));
        }
        let name = self.name.read("barrier.name")?;
        let parties = text::read_all(self.parties, self.parties_count, "barrier.parties")?;
        let mut barrier = if self.flags & SINEW_PHASE == 0 {
            sinew::barrier::Barrier::new(name, parties)
        } else {
            sinew::barrier::Barrier::phase(name, parties)
        };
        if self.within_ns != 0 {
            barrier = barrier.within(Duration::from_millis(self.within_ns.div_ceil(1_000_000)));
        }
        let is_failing = self.flags & SINEW_FAIL_ON_LOSS != 0;
        Ok(barrier.on_loss(if is_failing { OnPartyLoss::Fail } else { OnPartyLoss::Wait }))
    }
}

impl From<BarrierError> for Fault {
    fn from(error: BarrierError) -> Self {
        let sentence = error.to_string();
        let status = match error {
            BarrierError::TimedOut { .. } => Status::SinewErrorNotMet,
            BarrierError::Lost { .. } => Status::SinewErrorPartyLost,
            BarrierError::Refused(_) => Status::SinewErrorRefused,
            BarrierError::Api(error) => return error.into(),
            // An endpoint asks in no other way.
            BarrierError::Send(_) | BarrierError::Ask(_) => Status::SinewErrorNotHandled,
        };
        Self::new(status, sentence)
    }
}
