//! The stop of the whole system: pressing it, its state, and its acknowledgement.

use std::{ffi::c_char, mem::MaybeUninit, time::Duration};

use sinew_client::ApiError;
use sinew_runtime::{
    outcome::Outcome,
    stop::{self as model, AskStop},
    tid::{AppAddress, Tid},
};

use crate::{
    ffi_boundary::call,
    message::{Endpoint, TidBits, nanos},
    registration::with,
    session::Session,
    status::Status,
    text::{self, Text},
};

/// For the times of `sinew_stop_node`: there is none.
pub const SINEW_STOP_NO_TIME: u64 = u64::MAX;
/// Bytes of a node's name in `sinew_stop_node`, with its zero.
pub const SINEW_STOP_NAME: usize = 64;
/// Maximum number of nodes that a report has.
const NODES_MAX: usize = 1_024;
/// Longest wait for confirmations. A node waits no longer either.
const WITHIN_MAX: Duration = Duration::from_secs(60);
/// The reason of a press, if its own one cannot be read.
const NO_REASON: &str = "the reason cannot be read";

/// Whether a node is stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum StopState {
    /// Nothing was received from the node.
    SinewStopUnknown = 0,
    /// Outputs may be armed.
    SinewStopReleased = 1,
    /// No press is known. Outputs stay as they are and cannot be armed: the node does not know yet whether
    /// the others are stopped.
    SinewStopHeld = 2,
    /// A stop is in force.
    SinewStopStopped = 3,
}

/// One node's part in the stop.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct StopNode {
    /// The address of its stop, which has the node.
    pub tid: TidBits,
    /// Time from the newest press until the confirmation was there; `SINEW_STOP_NO_TIME`: the node has not
    /// confirmed, and may still move.
    pub confirmed_ns: u64,
    /// Time after the press within which the node's own watchdogs make its outputs safe although it has not
    /// confirmed; `SINEW_STOP_NO_TIME`: no such time is known.
    pub bound_ns: u64,
    /// One of `sinew_stop_state`.
    pub state: i32,
    /// Number of guarded outputs in its process.
    pub outputs: u32,
    /// Its name, of which the first bytes are kept, terminated by a zero.
    pub name: [c_char; SINEW_STOP_NAME],
}

/// The state of the stop, as the endpoint's node knows it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct StopReport {
    /// Number of nodes, the endpoint's own first; may be above the capacity that was given.
    pub nodes: usize,
    /// Number of presses that are not released.
    pub presses: usize,
    /// State of the endpoint's node: one of `sinew_stop_state`.
    pub state: i32,
    /// Whether the system is stopped and every known node has confirmed that its outputs are safe.
    pub is_confirmed: bool,
    /// Zeros.
    pub reserved: [u8; 3],
}

/// Presses the stop of the whole system: every guarded output of every node becomes safe, and stays so until
/// an operator has released the stop, and each application has acknowledged it and armed its output again. It
/// is no safety function.
///
/// Returns when all nodes have confirmed, and after `within_ns` at the latest, which counts as 60 s at most.
/// Then the first `capacity` nodes are in `nodes`, which may be NULL, and the state is in `*report`, which may
/// be NULL. Look at `is_confirmed`: `SINEW_OK` says only that the node has answered. A `reason` that cannot be
/// read is replaced, so that a wrong argument hinders no press. After an error the stop may be pressed; try
/// again, and cut the power. `SINEW_ERROR_LOAN_ACTIVE` and `SINEW_ERROR_BUSY`: it was not pressed; a button
/// has an endpoint of its own. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_press_stop(
    endpoint: *mut Endpoint,
    reason: Text,
    within_ns: u64,
    nodes: *mut StopNode,
    capacity: usize,
    report: Option<&mut MaybeUninit<StopReport>>,
) -> Status {
    call(|| {
        let reason = reason.read("reason").unwrap_or(NO_REASON);
        let within = Duration::from_nanos(within_ns).min(WITHIN_MAX);
        let found = with(endpoint, |session| Ok(session.endpoint().press_stop(reason, within)?))?;
        Ok(hand_over(&found, (nodes, capacity), report))
    })
}

/// Asks the endpoint's node for the state of the stop, and waits at most for `within_ns`. The results are
/// those of `sinew_press_stop`. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_ask_stop(
    endpoint: *mut Endpoint,
    within_ns: u64,
    nodes: *mut StopNode,
    capacity: usize,
    report: Option<&mut MaybeUninit<StopReport>>,
) -> Status {
    call(|| {
        let within = Duration::from_nanos(within_ns).min(WITHIN_MAX);
        let found = with(endpoint, |session| {
            let stop = stop_of(session);
            let asked = session.endpoint().message(stop, &AskStop {}).ask::<model::StopReport>(within);
            Ok(asked?)
        })?;
        Ok(hand_over(&found, (nodes, capacity), report))
    })
}

/// Acknowledges a stop that is released, and waits at most for `within_ns`: before that the outputs of this
/// endpoint cannot be armed, as its node hands over none of its echoes. Call it on the order of a person, or
/// of the application that coordinates the start. It moves nothing. `SINEW_ERROR_NOT_HANDLED`: a stop is in
/// force. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_acknowledge_stop(endpoint: *mut Endpoint, within_ns: u64) -> Status {
    call(|| {
        let within = Duration::from_nanos(within_ns).min(WITHIN_MAX);
        let outcome = with(endpoint, |session| Ok(session.endpoint().acknowledge_stop(within)?))?;
        if outcome == Outcome::Delivered { Ok(Status::SinewOk) } else { Err(ApiError::Ended(outcome).into()) }
    })
}

fn stop_of(session: &mut Session) -> Tid {
    Tid::new(session.endpoint().tid().node, AppAddress::STOP)
}

/// Writes a report to the memory of the caller.
fn hand_over(
    found: &model::StopReport,
    (nodes, capacity): (*mut StopNode, usize),
    report: Option<&mut MaybeUninit<StopReport>>,
) -> Status {
    let capacity = capacity.min(NODES_MAX);
    // SAFETY: the header requires that `capacity` nodes are valid, for this call only; any bytes are a
    // `MaybeUninit`.
    let room = unsafe { text::memory_mut(nodes.cast::<MaybeUninit<StopNode>>(), capacity) };
    for (slot, node) in room.unwrap_or_default().iter_mut().zip(&found.nodes) {
        slot.write(StopNode::of(node));
    }
    if let Some(report) = report {
        report.write(StopReport {
            nodes: found.nodes.len(),
            presses: found.presses.len(),
            state: StopState::of(Some(found.state)) as i32,
            is_confirmed: found.is_confirmed(),
            reserved: [0; 3],
        });
    }
    Status::SinewOk
}

impl StopState {
    const fn of(state: Option<model::StopState>) -> Self {
        match state {
            None => Self::SinewStopUnknown,
            Some(model::StopState::Released) => Self::SinewStopReleased,
            Some(model::StopState::Held) => Self::SinewStopHeld,
            Some(model::StopState::Stopped) => Self::SinewStopStopped,
        }
    }
}

impl StopNode {
    fn of(node: &model::StopNode) -> Self {
        let time = |micros: Option<u64>| {
            micros.map_or(SINEW_STOP_NO_TIME, |micros| nanos(Duration::from_micros(micros)))
        };
        let mut name = [0; SINEW_STOP_NAME];
        // The last byte stays zero. Another node may have any name.
        let kept = node.name.floor_char_boundary(SINEW_STOP_NAME - 1);
        for (to, byte) in name.iter_mut().zip(node.name.as_bytes().iter().take(kept)) {
            *to = *byte as c_char;
        }
        Self {
            tid: Tid::new(node.node, AppAddress::STOP).bits(),
            confirmed_ns: time(node.confirmed_us),
            bound_ns: time(node.bound_us),
            state: StopState::of(node.state) as i32,
            outputs: node.outputs,
            name,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::CStr;

    use super::*;

    fn node(name: &str) -> model::StopNode {
        model::StopNode {
            node: [127, 0, 0, 1].into(),
            name: name.to_owned(),
            state: None,
            confirmed_us: None,
            safe_us: None,
            outputs: 1,
            bound_us: Some(7),
            note: String::new(),
        }
    }

    #[test]
    fn long_name_ends_with_a_whole_character_and_zero() {
        let written = StopNode::of(&node(&"\u{e4}".repeat(40))).name;
        let bytes = written.map(|byte| byte as u8);
        let name = CStr::from_bytes_until_nul(&bytes).expect("it ends with a zero");
        assert_eq!(name.to_str(), Ok("\u{e4}".repeat(31).as_str()));
    }

    #[test]
    fn times_that_are_not_known_are_marked() {
        let written = StopNode::of(&node("knee"));
        assert_eq!((written.confirmed_ns, written.bound_ns), (SINEW_STOP_NO_TIME, 7_000));
        assert_eq!(written.state, StopState::SinewStopUnknown as i32);
    }

    #[test]
    fn press_without_an_endpoint_is_no_press() {
        let none = Text { bytes: std::ptr::null(), length: 3 };
        let status = sinew_press_stop(std::ptr::null_mut(), none, 0, std::ptr::null_mut(), 4, None);
        assert_eq!(status, Status::SinewErrorNoSuchEndpoint);
    }
}
