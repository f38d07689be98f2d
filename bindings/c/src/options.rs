//! Options of a registration, in a struct that may grow.

use std::{mem::MaybeUninit, ptr, time::Duration};

use sinew_client::{DirectLinks, Registration, Spin, Transport};
use sinew_model::facts::NodeEvent;
use sinew_runtime::{app::RequirementEvent, tid::AppAddress};

use crate::{
    status::CallError,
    text::{self, Text},
};

/// For `events` of `sinew_options`: `sinew.node_event`, nodes that are found, lost, restarted.
pub const SINEW_NODE_EVENTS: u32 = 1;
/// For `events` of `sinew_options`: `sinew.requirement_event`, requirements that are lost or met again.
pub const SINEW_REQUIREMENT_EVENTS: u32 = 2;
/// For `links` of `sinew_options`: through the unix socket only, no shared memory.
pub const SINEW_SOCKET_ONLY: u32 = 1;
/// For `links` of `sinew_options`: direct links with other processes that also have them. The endpoint accepts
/// links, and requests one to each peer with frequent messages: at the 8th message within one second. Of
/// `SINEW_DIRECT_AUTOMATIC`, `SINEW_DIRECT_ALWAYS` and `SINEW_DIRECT_NEVER` set one at most.
pub const SINEW_DIRECT_AUTOMATIC: u32 = 16;
/// For `links` of `sinew_options`: direct links with other processes that also have them. The endpoint accepts
/// links, and requests one at the first message to a peer.
pub const SINEW_DIRECT_ALWAYS: u32 = 2;
/// For `links` of `sinew_options`: all messages go through the node.
pub const SINEW_DIRECT_NEVER: u32 = 32;
/// For `links` of `sinew_options`: `spin_ns` is the maximum spin time. The endpoint spins about twice as long
/// as messages lately took to arrive, and not at all while they take longer than `spin_ns`. Without `spin_ns`
/// this does nothing.
pub const SINEW_SPIN_ADAPTIVE: u32 = 4;
/// For `links` of `sinew_options`: does not register again when the connection to the node has ended. Then
/// every call returns `SINEW_ERROR_CLOSED`. Without this the endpoint reconnects by itself.
pub const SINEW_WITHOUT_RECONNECT: u32 = 8;

/// Options of a registration. Set the whole struct to zero, then `size`, then the fields that you need; zero
/// means the default everywhere. The struct grows at its end only: a program compiled with a shorter one
/// works as before.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Options {
    /// `sizeof(sinew_options)`: tells the library the version that the program was compiled with.
    pub size: usize,
    /// The name, 1 to 63 bytes without control characters, unique on the node. Default: none.
    pub name: Text,
    /// Requirements that must be met, on this node or any, before this application is ready: `knee.drive`,
    /// `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `knee.drive at homed`, `camera ?2s`. At most 64.
    /// Default: none.
    pub required: *const Text,
    /// Number of requirements.
    pub required_count: usize,
    /// Names of the payload types that the application sends or handles, so that a hash collision of two of
    /// them is found at registration. At most 64. Default: none.
    pub handled: *const Text,
    /// Number of names.
    pub handled_count: usize,
    /// A fixed address, `0x1000` to `0x7fffffff`. Default: a dynamic one.
    pub fixed_address: u32,
    /// The events of the node's layers to receive: `SINEW_NODE_EVENTS`, `SINEW_REQUIREMENT_EVENTS`. Default:
    /// none.
    pub events: u32,
    /// Time limit of the registration, waiting for the requirements included. Default: 60 s.
    pub deadline_ns: u64,
    /// Stall timeout: how long a send waits while the node or, on a direct link, the receiver accepts
    /// nothing; any progress restarts that time. Default: 1 s. For the total time of one send:
    /// `sinew_room_within`.
    pub stall_timeout_ns: u64,
    /// Received messages that wait in this process before the library stops reading from the socket or the
    /// rings; more while a call waits for an answer. Default: 256.
    pub inbox_capacity: usize,
    /// Spin time: how long a thread that waits at a ring polls it before it sleeps. At a socket
    /// (`SINEW_SOCKET_ONLY`) it never spins. Spinning keeps a CPU busy and saves the wake-up, which is most
    /// of a short message's latency: for a thread with a CPU of its own. Default: it sleeps at once.
    pub spin_ns: u64,
    /// The transport of the messages: `SINEW_SOCKET_ONLY`, `SINEW_DIRECT_AUTOMATIC`, `SINEW_DIRECT_ALWAYS`,
    /// `SINEW_DIRECT_NEVER`, `SINEW_SPIN_ADAPTIVE`, `SINEW_WITHOUT_RECONNECT`. Default: shared memory if the
    /// system has it, `SINEW_DIRECT_AUTOMATIC`, and a reconnect when the connection has ended.
    pub links: u32,
    /// Zero.
    pub reserved: u32,
    /// Size in bytes of this side's ring of each direct link, from 4 KiB to 1 MiB (other values are clamped). It
    /// is rounded up to a power of two, and never more than the node's `lncl.ring_bytes`. A message longer than
    /// half of it is sent in pieces. All rings for direct links that a process creates take at most 64 MiB.
    /// Default: 64 KiB.
    pub direct_ring_bytes: usize,
}

/// Of these, `links` has one at most.
const DIRECT_LINKS: u32 = SINEW_DIRECT_AUTOMATIC | SINEW_DIRECT_ALWAYS | SINEW_DIRECT_NEVER;
const KNOWN_LINKS: u32 = SINEW_SOCKET_ONLY | DIRECT_LINKS | SINEW_SPIN_ADAPTIVE | SINEW_WITHOUT_RECONNECT;

/// The field with the length of the rest.
const SHORTEST: usize = size_of::<usize>();
/// No later version is longer.
const LONGEST: usize = 4096;

impl Options {
    /// Copies the options of a caller that may have been compiled with a shorter or a longer struct.
    pub(crate) fn read(options: *const Self) -> Result<Self, CallError> {
        if !options.is_aligned() {
            return Err(CallError::argument("`options` is not aligned"));
        }
        // SAFETY: not NULL (the caller has checked), aligned, and the header requires that its first field is
        // set.
        let size = unsafe { ptr::read(options.cast::<usize>()) };
        if !(SHORTEST..=LONGEST).contains(&size) {
            return Err(CallError::argument(format!(
                "`options.size` is {size}: set it to sizeof(sinew_options)"
            )));
        }
        // SAFETY: the header requires that `size` bytes are valid; `size` was checked.
        let bytes = unsafe { text::memory(options.cast::<u8>(), size) }.unwrap_or_default();
        let (known, later) = bytes.split_at(size_of::<Self>().min(size));
        if later.iter().any(|byte| *byte != 0) {
            return Err(CallError::argument(
                "`options` asks for what only a later version of this library can do",
            ));
        }
        let mut copy = MaybeUninit::<Self>::zeroed();
        // SAFETY: both have at least `known.len()` bytes, and nothing else uses the copy.
        unsafe { ptr::copy_nonoverlapping(known.as_ptr(), copy.as_mut_ptr().cast::<u8>(), known.len()) };
        // SAFETY: its fields are numbers and pointers, for which any bytes are valid.
        Ok(unsafe { copy.assume_init() })
    }

    /// Converts to the type of Rust's API.
    pub(crate) fn registration(&self) -> Result<Registration, CallError> {
        let mut registration = Registration::new();
        let name = self.name.read("options.name")?;
        if !name.is_empty() {
            registration = registration.name(name);
        }
        if self.fixed_address != 0 {
            registration = registration.fixed_address(AppAddress::new(self.fixed_address));
        }
        registration =
            registration.requires(text::read_all(self.required, self.required_count, "options.required")?);
        for kind in text::read_all(self.handled, self.handled_count, "options.handled")? {
            registration = registration.handles_named(kind);
        }
        self.with_links(self.with_limits(self.with_events(registration)?)?)
    }

    fn with_events(&self, mut registration: Registration) -> Result<Registration, CallError> {
        if self.events & !(SINEW_NODE_EVENTS | SINEW_REQUIREMENT_EVENTS) != 0 {
            return Err(CallError::argument(format!(
                "`options.events` is {:#x}: no such events",
                self.events
            )));
        }
        if self.events & SINEW_NODE_EVENTS != 0 {
            registration = registration.subscribe::<NodeEvent>();
        }
        if self.events & SINEW_REQUIREMENT_EVENTS != 0 {
            registration = registration.subscribe::<RequirementEvent>();
        }
        Ok(registration)
    }

    fn with_links(&self, mut registration: Registration) -> Result<Registration, CallError> {
        if self.reserved != 0 {
            return Err(CallError::argument(format!("`options.reserved` is {}: set it to 0", self.reserved)));
        }
        if self.links & !KNOWN_LINKS != 0 {
            return Err(CallError::argument(format!("`options.links` is {:#x}: no such links", self.links)));
        }
        if self.links & SINEW_SOCKET_ONLY != 0 {
            registration = registration.transport(Transport::Socket);
        }
        if let Some(links) = self.direct_links()? {
            registration = registration.direct(links);
        }
        if self.direct_ring_bytes != 0 {
            registration = registration.direct_ring_bytes(self.direct_ring_bytes);
        }
        if self.links & SINEW_WITHOUT_RECONNECT != 0 {
            registration = registration.without_reconnect();
        }
        let longest = Duration::from_nanos(self.spin_ns);
        Ok(match (self.spin_ns, self.links & SINEW_SPIN_ADAPTIVE) {
            (0, _) => registration,
            (_, 0) => registration.spin(Spin::For(longest)),
            (_, _) => registration.spin(Spin::Adaptive { max: longest }),
        })
    }

    /// Returns the requested direct links, or `None` for the default.
    fn direct_links(&self) -> Result<Option<DirectLinks>, CallError> {
        match self.links & DIRECT_LINKS {
            0 => Ok(None),
            SINEW_DIRECT_AUTOMATIC => Ok(Some(DirectLinks::Automatic)),
            SINEW_DIRECT_ALWAYS => Ok(Some(DirectLinks::Always)),
            SINEW_DIRECT_NEVER => Ok(Some(DirectLinks::Never)),
            _ => Err(CallError::argument(format!(
                "`options.links` is {:#x}: set one of SINEW_DIRECT_AUTOMATIC, SINEW_DIRECT_ALWAYS and \
                 SINEW_DIRECT_NEVER at most",
                self.links
            ))),
        }
    }

    fn with_limits(&self, mut registration: Registration) -> Result<Registration, CallError> {
        if self.deadline_ns != 0 {
            registration = registration.deadline(Duration::from_nanos(self.deadline_ns));
        }
        if self.stall_timeout_ns != 0 {
            registration = registration.stall_timeout(Duration::from_nanos(self.stall_timeout_ns));
        }
        if self.inbox_capacity > INBOX_MAX {
            return Err(CallError::argument(format!(
                "`options.inbox_capacity` is {}: at most {INBOX_MAX} messages",
                self.inbox_capacity
            )));
        }
        if self.inbox_capacity != 0 {
            registration = registration.inbox_capacity(self.inbox_capacity);
        }
        Ok(registration)
    }
}

/// The maximum of a node's own applications.
const INBOX_MAX: usize = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    fn zeroed(size: usize) -> Options {
        // SAFETY: its fields are numbers and pointers, for which zeros are valid.
        let mut options: Options = unsafe { std::mem::zeroed() };
        options.size = size;
        options
    }

    /// The struct of a later version.
    #[repr(C)]
    struct Later {
        options: Options,
        more: u64,
    }

    #[test]
    fn zeros_are_the_defaults() {
        let options = Options::read(&zeroed(size_of::<Options>())).unwrap();
        let asked = format!("{:?}", options.registration().unwrap());
        assert_eq!(asked, format!("{:?}", Registration::new()));
    }

    #[test]
    fn shorter_struct_gets_defaults_for_the_rest() {
        let mut options = zeroed(std::mem::offset_of!(Options, stall_timeout_ns));
        options.deadline_ns = 1;
        options.stall_timeout_ns = 2;
        let read = Options::read(&options).unwrap();
        assert_eq!((read.deadline_ns, read.stall_timeout_ns), (1, 0));
    }

    #[test]
    fn longer_struct_is_accepted_if_the_rest_is_zero() {
        let mut later = Later { options: zeroed(size_of::<Later>()), more: 0 };
        later.options.inbox_capacity = 5;
        assert_eq!(Options::read((&raw const later).cast()).unwrap().inbox_capacity, 5);
        later.more = 1;
        let error = format!("{:?}", Options::read((&raw const later).cast()).unwrap_err());
        assert!(error.contains("later version"), "{error}");
    }

    #[test]
    fn unknown_struct_size_is_rejected() {
        for size in [0, 7, SHORTEST - 1, LONGEST + 1, usize::MAX] {
            assert!(Options::read(&zeroed(size)).is_err(), "{size}");
        }
    }

    #[test]
    fn links_flags_select_the_transport() {
        let mut options = zeroed(size_of::<Options>());
        (options.links, options.spin_ns) = (SINEW_SOCKET_ONLY | SINEW_SPIN_ADAPTIVE, 5_000);
        let asked = format!("{:?}", options.registration().unwrap());
        let max = Duration::from_micros(5);
        let wanted = Registration::new().transport(Transport::Socket).spin(Spin::Adaptive { max });
        assert_eq!(asked, format!("{wanted:?}"));
    }

    #[test]
    fn links_flags_select_the_direct_links() {
        let mut options = zeroed(size_of::<Options>());
        for (flag, links) in [
            (SINEW_DIRECT_AUTOMATIC, DirectLinks::Automatic),
            (SINEW_DIRECT_ALWAYS, DirectLinks::Always),
            (SINEW_DIRECT_NEVER, DirectLinks::Never),
        ] {
            options.links = flag;
            let asked = format!("{:?}", options.registration().unwrap());
            assert_eq!(asked, format!("{:?}", Registration::new().direct(links)));
        }
    }

    #[test]
    fn several_direct_links_flags_are_rejected() {
        let mut options = zeroed(size_of::<Options>());
        let several =
            [SINEW_DIRECT_AUTOMATIC | SINEW_DIRECT_ALWAYS, SINEW_DIRECT_ALWAYS | SINEW_DIRECT_NEVER];
        for links in several {
            options.links = links;
            let error = format!("{:?}", options.registration().unwrap_err());
            assert!(error.contains("set one of SINEW_DIRECT_AUTOMATIC"), "{error}");
        }
    }

    #[test]
    fn ring_bytes_and_reconnect_are_configurable() {
        let mut options = zeroed(size_of::<Options>());
        (options.links, options.direct_ring_bytes) = (SINEW_DIRECT_ALWAYS | SINEW_WITHOUT_RECONNECT, 1 << 18);
        let asked = format!("{:?}", options.registration().unwrap());
        let wanted = Registration::new().direct(DirectLinks::Always).direct_ring_bytes(1 << 18);
        let wanted = wanted.without_reconnect();
        assert_eq!(asked, format!("{wanted:?}"));
    }

    #[test]
    fn program_without_ring_bytes_gets_the_default() {
        let mut options = zeroed(std::mem::offset_of!(Options, direct_ring_bytes));
        (options.links, options.direct_ring_bytes) = (SINEW_DIRECT_ALWAYS, 1 << 18);
        let asked = format!("{:?}", Options::read(&options).unwrap().registration().unwrap());
        assert_eq!(asked, format!("{:?}", Registration::new().direct(DirectLinks::Always)));
    }

    #[test]
    fn unknown_options_are_rejected() {
        let mut options = zeroed(size_of::<Options>());
        options.events = 4;
        assert!(options.registration().is_err());
        let mut options = zeroed(size_of::<Options>());
        options.links = 64;
        assert!(options.registration().is_err());
        let mut options = zeroed(size_of::<Options>());
        options.reserved = 1;
        let error = format!("{:?}", options.registration().unwrap_err());
        assert!(error.contains("`options.reserved` is 1"), "{error}");
        let mut options = zeroed(size_of::<Options>());
        options.inbox_capacity = INBOX_MAX + 1;
        assert!(options.registration().is_err());
    }
}
