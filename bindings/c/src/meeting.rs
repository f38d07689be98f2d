//! Barriers: several applications, on any nodes, continue together, or start in phases.

use std::{mem::MaybeUninit, time::Duration};

use sinew_client::BarrierError;
use sinew_model::barrier::OnPartyLoss;

use crate::{
    ffi_boundary::{call, present, write},
    message::Endpoint,
    registration::with,
    status::{CallError, Status},
    text::{self, Text},
};

/// For `flags` of `sinew_barrier`: does not wait for the return of a party that is listed by its name and has
/// failed, was stopped, or is on a lost node. Then `sinew_meet` returns `SINEW_ERROR_PARTY_LOST`.
pub const SINEW_FAIL_ON_LOSS: u32 = 1;
/// For `flags` of `sinew_barrier`: a phase. A party that has reached it counts until it is unregistered, also
/// while it does something else: an application that is restarted continues at once if the other parties have
/// arrived.
pub const SINEW_PHASE: u32 = 2;

const KNOWN_FLAGS: u32 = SINEW_FAIL_ON_LOSS | SINEW_PHASE;

/// A barrier: a point where several applications, on any nodes, wait for each other. It need not be created,
/// and can be used again and again. Set the whole struct to zero, then the fields that you need. All parties
/// give the same name and the same list of parties.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Barrier {
    /// The name, 1 to 63 bytes; of a phase one word.
    pub name: Text,
    /// The parties that have to arrive: `knee.drive`, `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `3 of
    /// *`. At most 64. The endpoint that waits must be one of them.
    pub parties: *const Text,
    /// Number of parties.
    pub parties_count: usize,
    /// Longest wait, rounded up to milliseconds. Default: 60 s.
    pub within_ns: u64,
    /// `SINEW_FAIL_ON_LOSS`, `SINEW_PHASE`. Default: neither.
    pub flags: u32,
    /// Zero.
    pub reserved: u32,
}

/// Arrives at a barrier and waits until all parties have arrived, at most for `within_ns` of the barrier.
/// `*generation` is the number of times that the barrier has opened, the same for all parties that continue
/// together (1 for a phase); `generation` may be NULL. Messages that arrive meanwhile wait to be received.
/// `SINEW_ERROR_NOT_MET`: not all arrived in time. `SINEW_ERROR_PARTY_LOST`: one was lost, and the flags say
/// not to wait for it. The sentence of both says which parties are missing, and why. `SINEW_ERROR_REFUSED`:
/// this endpoint is not one of the parties, or the barrier is invalid; the sentence says why. After any other
/// error the endpoint counts as arrived until the barrier's time is over. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_meet(
    endpoint: *mut Endpoint,
    barrier: Option<&Barrier>,
    generation: Option<&mut MaybeUninit<u64>>,
) -> Status {
    call(|| {
        let barrier = present(barrier, "barrier")?.read()?;
        let opened = with(endpoint, |session| session.endpoint().meet(&barrier).map_err(CallError::from))?;
        Ok(generation.map_or(Status::SinewOk, |generation| write(generation, opened)))
    })
}

impl Barrier {
    /// Converts to the type of Rust's API.
    fn read(&self) -> Result<sinew_client::Barrier, CallError> {
        if self.flags & !KNOWN_FLAGS != 0 {
            return Err(CallError::argument(format!("`barrier.flags` is {:#x}: no such flags", self.flags)));
        }
        if self.reserved != 0 {
            return Err(CallError::argument(format!("`barrier.reserved` is {}: set it to 0", self.reserved)));
        }
        let name = self.name.read("barrier.name")?;
        let parties = text::read_all(self.parties, self.parties_count, "barrier.parties")?;
        let mut barrier = if self.flags & SINEW_PHASE == 0 {
            sinew_client::Barrier::new(name, parties)
        } else {
            sinew_client::Barrier::phase(name, parties)
        };
        if self.within_ns != 0 {
            barrier = barrier.within(Duration::from_millis(self.within_ns.div_ceil(1_000_000)));
        }
        let is_failing = self.flags & SINEW_FAIL_ON_LOSS != 0;
        Ok(barrier.on_loss(if is_failing { OnPartyLoss::Fail } else { OnPartyLoss::Wait }))
    }
}

impl From<BarrierError> for CallError {
    fn from(error: BarrierError) -> Self {
        let sentence = error.to_string();
        let status = match error {
            BarrierError::TimedOut { .. } => Status::SinewErrorNotMet,
            BarrierError::Lost { .. } => Status::SinewErrorPartyLost,
            BarrierError::Refused(_) => Status::SinewErrorRefused,
            BarrierError::Api(error) => return error.into(),
            // An endpoint returns no other error of sending or asking here.
            BarrierError::Send(_) | BarrierError::Ask(_) => Status::SinewErrorNotHandled,
        };
        Self::new(status, sentence)
    }
}
