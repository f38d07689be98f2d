//! What an application asks for when it registers, in a struct that may grow.

use std::{mem::MaybeUninit, ptr, time::Duration};

use sinew::{
    AppAddress, Registration,
    client::{Spin, Transport},
    events::{NodeEvent, RequirementEvent},
};

use crate::{
    status::Fault,
    text::{self, Text},
};

/// For `events` of `sinew_options`: `sinew.node_event`, nodes that are found, lost, restarted.
pub const SINEW_NODE_EVENTS: u32 = 1;
/// For `events` of `sinew_options`: `sinew.requirement_event`, what is required is lost or there again.
pub const SINEW_REQUIREMENT_EVENTS: u32 = 2;
/// For `links` of `sinew_options`: through the unix socket alone, no shared memory.
pub const SINEW_SOCKET_ONLY: u32 = 1;
/// For `links` of `sinew_options`: direct links to other processes that ask for them too.
pub const SINEW_DIRECT: u32 = 2;
/// For `links` of `sinew_options`: `spin_ns` is the longest to look. It looks about twice as long as messages lately took to come,
/// and not at all while they take longer than `spin_ns`. Without `spin_ns` this does nothing.
pub const SINEW_SPIN_ADAPTIVE: u32 = 4;
/// For `links` of `sinew_options`: does not register again when the connection to the node has ended. Then every call says
/// `SINEW_ERROR_CLOSED`. Without this the endpoint comes back by itself.
pub const SINEW_WITHOUT_RECONNECT: u32 = 8;

/// What an application asks for when it registers. Set all of it to zero, then `size`, then what is wanted; zero means the
/// default everywhere. It grows at its end only: a program that was compiled with a shorter one is served as before.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Options {
    /// `sizeof(sinew_options)`, by which the library knows what the program was compiled with.
    pub size: usize,
    /// The name, 1 to 63 bytes without control characters, unique on the node. Default: none.
    pub name: Text,
    /// What must be met, on this node or any, before this application is ready: `knee.drive`, `*.drive`, `hip.imu | knee.imu`,
    /// `2 of *.drive`, `knee.drive at homed`, `camera ?2s`. At most 64. Default: none.
    pub required: *const Text,
    /// How many.
    pub required_count: usize,
    /// Names of the payload types that the application sends or handles, so that two which hash alike are found at
    /// registration. At most 64. Default: none.
    pub handled: *const Text,
    /// How many.
    pub handled_count: usize,
    /// A fixed address, `0x1000` to `0x7fffffff`. Default: a dynamic one.
    pub fixed_address: u32,
    /// The events of the node's layers to be received: `SINEW_NODE_EVENTS`, `SINEW_REQUIREMENT_EVENTS`. Default: none.
    pub events: u32,
    /// How long the registration may take, waiting for what is required included. Default: 60 s.
    pub deadline_ns: u64,
    /// How long a send waits while the node or, on a direct link, the receiver takes nothing; whatever it takes begins that time
    /// anew. Default: 1 s. For one send alone, and in all: `sinew_room_within`.
    pub stall_timeout_ns: u64,
    /// How many received messages wait in this process until no more are taken out of the socket or the rings; more while an
    /// answer is waited for. Default: 256.
    pub inbox_capacity: usize,
    /// How long a thread that waits at a ring looks at it before it sleeps; at a socket (`SINEW_SOCKET_ONLY`) it never looks.
    /// Looking keeps a CPU busy and saves the wake, which is most of a short message's way: for a thread with a CPU of its
    /// own. Default: it sleeps at once.
    pub spin_ns: u64,
    /// What carries the messages: `SINEW_SOCKET_ONLY`, `SINEW_DIRECT`, `SINEW_SPIN_ADAPTIVE`, `SINEW_WITHOUT_RECONNECT`. Default:
    /// shared memory where the system has it, all through the node, and again when the connection has ended.
    pub links: u32,
    /// Zero.
    pub reserved: u32,
    /// Bytes of this side's ring of each direct link, from 4 KiB to 1 MiB (less or more is taken for those), rounded up to a
    /// power of two and never more than the node's `lncl.ring_bytes`. A message longer than half of it goes in pieces. All
    /// rings for direct links that a process makes take 64 MiB at most. Default: 64 KiB.
    pub direct_ring_bytes: usize,
}

const KNOWN_LINKS: u32 = SINEW_SOCKET_ONLY | SINEW_DIRECT | SINEW_SPIN_ADAPTIVE | SINEW_WITHOUT_RECONNECT;

/// What says how long the rest is.
const SHORTEST: usize = size_of::<usize>();
/// No later version is longer.
const LONGEST: usize = 4096;

impl Options {
    /// Copies the options of a caller, who may have been compiled with a shorter or a longer struct.
    pub(crate) fn read(options: *const Self) -> Result<Self, Fault> {
        if !options.is_aligned() {
            return Err(Fault::argument("`options` is not aligned"));
        }
        // SAFETY: not NULL (the caller of this looked), aligned, and the header asks that its first field is set.
        let size = unsafe { ptr::read(options.cast::<usize>()) };
        if !(SHORTEST..=LONGEST).contains(&size) {
            return Err(Fault::argument(format!(
                "`options.size` is {size}: set it to sizeof(sinew_options)"
            )));
        }
        // SAFETY: the header asks that so many bytes are there; how many, was checked.
        let bytes = unsafe { text::memory(options.cast::<u8>(), size) }.unwrap_or_default();
        let (known, later) = bytes.split_at(size_of::<Self>().min(size));
        if later.iter().any(|byte| *byte != 0) {
            return Err(Fault::argument(
                "`options` asks for what only a later version of this library can do",
            ));
        }
        let mut copy = MaybeUninit::<Self>::zeroed();
        // SAFETY: both have at least as many bytes, and the copy is nobody else's.
        unsafe { ptr::copy_nonoverlapping(known.as_ptr(), copy.as_mut_ptr().cast::<u8>(), known.len()) };
        // SAFETY: its fields are numbers and pointers, which any bytes are.
        Ok(unsafe { copy.assume_init() })
    }

    /// As Rust says it.
    pub(crate) fn registration(&self) -> Result<Registration, Fault> {
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

    fn with_events(&self, mut registration: Registration) -> Result<Registration, Fault> {
        if self.events & !(SINEW_NODE_EVENTS | SINEW_REQUIREMENT_EVENTS) != 0 {
            return Err(Fault::argument(format!("`options.events` is {:#x}: no such events", self.events)));
        }
        if self.events & SINEW_NODE_EVENTS != 0 {
            registration = registration.subscribe::<NodeEvent>();
        }
        if self.events & SINEW_REQUIREMENT_EVENTS != 0 {
            registration = registration.subscribe::<RequirementEvent>();
        }
        Ok(registration)
    }

    fn with_links(&self, mut registration: Registration) -> Result<Registration, Fault> {
        if self.reserved != 0 {
            return Err(Fault::argument(format!("`options.reserved` is {}: set it to 0", self.reserved)));
        }
        if self.links & !KNOWN_LINKS != 0 {
            return Err(Fault::argument(format!("`options.links` is {:#x}: no such links", self.links)));
        }
        if self.links & SINEW_SOCKET_ONLY != 0 {
            registration = registration.transport(Transport::Socket);
        }
        if self.links & SINEW_DIRECT != 0 {
            registration = registration.direct(true);
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

    fn with_limits(&self, mut registration: Registration) -> Result<Registration, Fault> {
        if self.deadline_ns != 0 {
            registration = registration.deadline(Duration::from_nanos(self.deadline_ns));
        }
        if self.stall_timeout_ns != 0 {
            registration = registration.stall_timeout(Duration::from_nanos(self.stall_timeout_ns));
        }
        if self.inbox_capacity > INBOX_MAX {
            return Err(Fault::argument(format!(
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

/// As many as a node's own applications may have.
const INBOX_MAX: usize = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    fn zeroed(size: usize) -> Options {
        // SAFETY: its fields are numbers and pointers, which zeros are.
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
    fn of_a_shorter_struct_the_rest_is_the_default() {
        let mut options = zeroed(std::mem::offset_of!(Options, stall_timeout_ns));
        options.deadline_ns = 1;
        options.stall_timeout_ns = 2;
        let read = Options::read(&options).unwrap();
        assert_eq!((read.deadline_ns, read.stall_timeout_ns), (1, 0));
    }

    #[test]
    fn a_longer_struct_is_read_if_it_asks_for_nothing_more() {
        let mut later = Later { options: zeroed(size_of::<Later>()), more: 0 };
        later.options.inbox_capacity = 5;
        assert_eq!(Options::read((&raw const later).cast()).unwrap().inbox_capacity, 5);
        later.more = 1;
        let fault = format!("{:?}", Options::read((&raw const later).cast()).unwrap_err());
        assert!(fault.contains("later version"), "{fault}");
    }

    #[test]
    fn a_size_that_no_version_has_is_refused() {
        for size in [0, 7, SHORTEST - 1, LONGEST + 1, usize::MAX] {
            assert!(Options::read(&zeroed(size)).is_err(), "{size}");
        }
    }

    #[test]
    fn links_are_chosen() {
        let mut options = zeroed(size_of::<Options>());
        (options.links, options.spin_ns) = (SINEW_SOCKET_ONLY | SINEW_SPIN_ADAPTIVE, 5_000);
        let asked = format!("{:?}", options.registration().unwrap());
        let max = Duration::from_micros(5);
        let wanted = Registration::new().transport(Transport::Socket).spin(Spin::Adaptive { max });
        assert_eq!(asked, format!("{wanted:?}"));
    }

    #[test]
    fn the_rings_of_direct_links_and_the_return_are_chosen() {
        let mut options = zeroed(size_of::<Options>());
        (options.links, options.direct_ring_bytes) = (SINEW_DIRECT | SINEW_WITHOUT_RECONNECT, 1 << 18);
        let asked = format!("{:?}", options.registration().unwrap());
        let wanted = Registration::new().direct(true).direct_ring_bytes(1 << 18).without_reconnect();
        assert_eq!(asked, format!("{wanted:?}"));
    }

    #[test]
    fn a_program_compiled_before_there_were_ring_bytes_has_the_default() {
        let mut options = zeroed(std::mem::offset_of!(Options, direct_ring_bytes));
        (options.links, options.direct_ring_bytes) = (SINEW_DIRECT, 1 << 18);
        let asked = format!("{:?}", Options::read(&options).unwrap().registration().unwrap());
        assert_eq!(asked, format!("{:?}", Registration::new().direct(true)));
    }

    #[test]
    fn what_does_not_exist_cannot_be_asked_for() {
        let mut options = zeroed(size_of::<Options>());
        options.events = 4;
        assert!(options.registration().is_err());
        let mut options = zeroed(size_of::<Options>());
        options.links = 16;
        assert!(options.registration().is_err());
        let mut options = zeroed(size_of::<Options>());
        options.reserved = 1;
        let fault = format!("{:?}", options.registration().unwrap_err());
        assert!(fault.contains("`options.reserved` is 1"), "{fault}");
        let mut options = zeroed(size_of::<Options>());
        options.inbox_capacity = INBOX_MAX + 1;
        assert!(options.registration().is_err());
    }
}
