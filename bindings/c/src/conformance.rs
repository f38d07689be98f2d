//! A safe Rust wrapper of the C functions, for NodeAPI's conformance suite (`actors/client/src/tests/`).
//! Compiled with the feature `conformance` only.
//!
//! Each method is one call of a C function with the structs that C passes. It returns the status unchanged,
//! with its sentence. Payloads are copied where a program in C would read or write them: Rust's borrows
//! cannot express the C rules for memory (invalid after its message is gone, or its endpoint).

use std::{
    ffi::{CStr, c_char},
    fmt,
    mem::{self, MaybeUninit},
    ops::{Deref, DerefMut},
    os::unix::ffi::OsStrExt,
    path::Path,
    ptr, slice, thread,
};

pub use crate::{
    message::Undelivered,
    options::{
        SINEW_DIRECT_ALWAYS, SINEW_DIRECT_AUTOMATIC, SINEW_DIRECT_NEVER, SINEW_SOCKET_ONLY,
        SINEW_WITHOUT_RECONNECT,
    },
    outcome::Outcome,
    status::Status,
};
use crate::{
    message::{self, Message},
    naming::{sinew_join_group, sinew_leave_group, sinew_resolve},
    options::Options,
    outcome::sinew_last_error,
    receiving::{sinew_next_undelivered, sinew_receive_message, sinew_settle_message},
    registration::{
        sinew_endpoint_tid, sinew_node_name, sinew_payload_max, sinew_register_transport_address,
        sinew_unregister,
    },
    sending::{
        sinew_ask, sinew_create_message, sinew_discard_message, sinew_reply, sinew_room_within,
        sinew_send_bytes, sinew_send_message, sinew_send_message_confirmed,
        sinew_send_message_confirmed_by_each,
    },
    text::Text,
};

/// The result of a C function other than `SINEW_OK`.
#[derive(Clone, Debug)]
pub struct StatusError {
    /// The returned status.
    pub status: Status,
    /// The text of `sinew_last_error`.
    pub sentence: String,
    /// The outcome of a request that was not handled.
    pub ended: Option<Outcome>,
}

/// The settings of `sinew_options`; zero and empty are the defaults.
#[derive(Clone, Debug, Default)]
#[expect(missing_docs, reason = "each is the field of sinew_options that has its name")]
pub struct Asked {
    pub name: String,
    pub required: Vec<String>,
    pub handled: Vec<String>,
    pub fixed_address: u32,
    pub deadline_ns: u64,
    pub stall_timeout_ns: u64,
    pub inbox_capacity: usize,
    pub links: u32,
}

/// An endpoint; unregistered when it is dropped.
#[derive(Debug)]
pub struct Endpoint {
    handle: usize,
}

/// A message under construction; discarded when it is dropped.
#[derive(Debug)]
pub struct Made {
    owner: usize,
    message: Given<Message>,
    payload: Vec<u8>,
}

/// A received message. Settled when it is dropped: as Failed by a thread that panics, else as Delivered.
#[derive(Debug)]
pub struct InHand {
    owner: usize,
    message: Given<message::Received>,
    payload: Vec<u8>,
}

/// A struct filled in by C, with a pointer in it.
struct Given<T>(T);

// SAFETY: the header allows another thread to use the struct and its `bytes`. Only the calls of the endpoint
// dereference them here.
unsafe impl<T> Send for Given<T> {}

impl<T> fmt::Debug for Given<T> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("of C")
    }
}

/// Returns `Ok` for `SINEW_OK`, else the error.
fn done(status: Status) -> Result<(), StatusError> {
    if status == Status::SinewOk { Ok(()) } else { Err(told(status)) }
}

fn told(status: Status) -> StatusError {
    // SAFETY: it is a C string that stays until this thread's next error.
    let sentence = unsafe { CStr::from_ptr(sinew_last_error()) };
    StatusError { status, sentence: sentence.to_string_lossy().into_owned(), ended: None }
}

fn text(text: &[u8]) -> Text {
    Text { bytes: text.as_ptr().cast::<c_char>(), length: text.len() }
}

fn texts(names: &[String]) -> Vec<Text> {
    names.iter().map(|name| text(name.as_bytes())).collect()
}

impl Endpoint {
    /// `sinew_register_transport_address`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn register(socket: &Path, asked: &Asked) -> Result<Self, StatusError> {
        let (required, handled) = (texts(&asked.required), texts(&asked.handled));
        let options = Options {
            size: size_of::<Options>(),
            name: text(asked.name.as_bytes()),
            required: required.as_ptr(),
            required_count: required.len(),
            handled: handled.as_ptr(),
            handled_count: handled.len(),
            fixed_address: asked.fixed_address,
            events: 0,
            deadline_ns: asked.deadline_ns,
            stall_timeout_ns: asked.stall_timeout_ns,
            inbox_capacity: asked.inbox_capacity,
            spin_ns: 0,
            links: asked.links,
            reserved: 0,
            direct_ring_bytes: 0,
        };
        let mut endpoint = MaybeUninit::new(ptr::null_mut());
        let path = text(socket.as_os_str().as_bytes());
        done(sinew_register_transport_address(path, &raw const options, Some(&mut endpoint)))?;
        // SAFETY: it was initialized with a value.
        let endpoint = unsafe { endpoint.assume_init() };
        Ok(Self { handle: endpoint.addr() })
    }

    const fn pointer(&self) -> *mut message::Endpoint {
        ptr::without_provenance_mut(self.handle)
    }

    /// `sinew_endpoint_tid`.
    #[must_use]
    pub fn tid(&self) -> u64 {
        sinew_endpoint_tid(self.pointer())
    }

    /// `sinew_payload_max`.
    #[must_use]
    pub fn payload_max(&self) -> usize {
        sinew_payload_max(self.pointer())
    }

    /// `sinew_node_name`.
    #[must_use]
    pub fn node_name(&self) -> &str {
        let name = sinew_node_name(self.pointer());
        assert!(!name.is_null(), "it is registered, and no other thread is in a call");
        // SAFETY: it is not NULL. It is a C string that stays until the endpoint is unregistered, and this
        // borrow ends before.
        unsafe { CStr::from_ptr(name) }.to_str().expect("a node's name is UTF-8")
    }

    /// `sinew_create_message`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn create(
        &mut self,
        destination: u64,
        kind: u32,
        message_class: i32,
        length: usize,
    ) -> Result<Made, StatusError> {
        let mut message = MaybeUninit::new(Message::GONE);
        done(sinew_create_message(
            self.pointer(),
            destination,
            kind,
            message_class,
            length,
            Some(&mut message),
        ))?;
        // SAFETY: it was initialized with a value.
        let message = unsafe { message.assume_init() };
        assert_eq!(message.length, length);
        // SAFETY: the message has `length` bytes until it is sent or discarded, and nothing else uses them.
        let payload = unsafe { slice::from_raw_parts(message.bytes, length) }.to_vec();
        Ok(Made { owner: self.handle, message: Given(message), payload })
    }

    /// Writes the payload into the message's memory, as a program in C would. Leaves a message of another
    /// endpoint as it is.
    fn fill(&self, made: &mut Made) {
        if made.owner == self.handle {
            let message = made.message.0;
            // SAFETY: `message.length` bytes are valid: the message is neither sent nor discarded, since it
            // is here, and its endpoint is this one, which is registered. Nothing else uses them.
            unsafe { ptr::copy_nonoverlapping(made.payload.as_ptr(), message.bytes, message.length) };
        }
    }

    /// `sinew_send_message`, after `sinew_room_within` if there is a time.
    ///
    /// # Errors
    /// Those of the C functions.
    pub fn send(&mut self, mut made: Made, within_ns: Option<u64>) -> Result<(), StatusError> {
        self.fill(&mut made);
        self.set_room_within(&made, within_ns)?;
        done(sinew_send_message(self.pointer(), Some(&mut made.message.0)))
    }

    fn set_room_within(&self, made: &Made, within_ns: Option<u64>) -> Result<(), StatusError> {
        within_ns.map_or(Ok(()), |time| done(sinew_room_within(self.pointer(), Some(&made.message.0), time)))
    }

    /// `sinew_send_bytes`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn send_bytes(
        &mut self,
        destination: u64,
        (kind, message_class): (u32, i32),
        bytes: &[u8],
    ) -> Result<(), StatusError> {
        let (endpoint, first, length) = (self.pointer(), bytes.as_ptr().cast(), bytes.len());
        done(sinew_send_bytes(endpoint, destination, kind, message_class, first, length))
    }

    /// `sinew_send_message_confirmed`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn send_confirmed(&mut self, mut made: Made, within_ns: u64) -> Result<Outcome, StatusError> {
        self.fill(&mut made);
        let mut outcome = MaybeUninit::new(Outcome::SinewUnknown);
        let message = Some(&mut made.message.0);
        done(sinew_send_message_confirmed(self.pointer(), message, within_ns, Some(&mut outcome)))?;
        // SAFETY: it was initialized with a value.
        Ok(unsafe { outcome.assume_init() })
    }

    /// `sinew_send_message_confirmed_by_each`: the TID and the outcome of each member.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn send_confirmed_by_each(
        &mut self,
        mut made: Made,
        within_ns: u64,
    ) -> Result<Vec<(u64, i32)>, StatusError> {
        self.fill(&mut made);
        const NONE: message::MemberOutcome = message::MemberOutcome { tid: 0, outcome: -1, reserved: 0 };
        let mut members = [NONE; 8];
        let mut count = MaybeUninit::new(0);
        let (message, room) = (Some(&mut made.message.0), members.as_mut_ptr());
        let (endpoint, capacity) = (self.pointer(), members.len());
        let status = sinew_send_message_confirmed_by_each(
            endpoint,
            message,
            within_ns,
            room,
            capacity,
            Some(&mut count),
        );
        done(status)?;
        // SAFETY: it was initialized with a value.
        let count = unsafe { count.assume_init() };
        Ok(members[..count].iter().map(|member| (member.tid, member.outcome)).collect())
    }

    /// `sinew_ask`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn ask(&mut self, mut made: Made, within_ns: u64) -> Result<InHand, StatusError> {
        self.fill(&mut made);
        let mut reply = MaybeUninit::new(message::Received::GONE);
        let mut ended = MaybeUninit::new(Outcome::SinewUnknown);
        let message = Some(&mut made.message.0);
        let status = sinew_ask(self.pointer(), message, within_ns, Some(&mut reply), Some(&mut ended));
        // SAFETY: it was initialized with a value.
        let ended = unsafe { ended.assume_init() };
        done(status).map_err(|told| StatusError {
            ended: (status == Status::SinewErrorNotHandled).then_some(ended),
            ..told
        })?;
        Ok(self.in_hand(reply))
    }

    /// `sinew_reply`, after `sinew_room_within` if there is a time.
    ///
    /// # Errors
    /// Those of the C functions.
    pub fn reply(
        &mut self,
        request: &InHand,
        mut made: Made,
        within_ns: Option<u64>,
    ) -> Result<(), StatusError> {
        self.fill(&mut made);
        self.set_room_within(&made, within_ns)?;
        let (request, message) = (Some(&request.message.0), Some(&mut made.message.0));
        done(sinew_reply(self.pointer(), request, message))
    }

    /// `sinew_receive_message`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn receive(&mut self, within_ns: u64) -> Result<Option<InHand>, StatusError> {
        let mut received = MaybeUninit::new(message::Received::GONE);
        let status = sinew_receive_message(self.pointer(), within_ns, Some(&mut received));
        if status == Status::SinewNothing {
            return Ok(None);
        }
        done(status).map(|()| Some(self.in_hand(received)))
    }

    fn in_hand(&self, received: MaybeUninit<message::Received>) -> InHand {
        // SAFETY: both callers initialized it with a value.
        let received = unsafe { received.assume_init() };
        // SAFETY: the message has `received.length` bytes until it is settled, and nothing writes them.
        let payload = unsafe { slice::from_raw_parts(received.bytes, received.length) }.to_vec();
        InHand { owner: self.handle, message: Given(received), payload }
    }

    /// `sinew_next_undelivered`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn next_undelivered(&mut self) -> Result<Option<Undelivered>, StatusError> {
        let mut undelivered = MaybeUninit::<Undelivered>::zeroed();
        let status = sinew_next_undelivered(self.pointer(), Some(&mut undelivered));
        if status == Status::SinewNothing {
            return Ok(None);
        }
        // SAFETY: all zeros are a valid value of it.
        done(status).map(|()| Some(unsafe { undelivered.assume_init() }))
    }

    /// `sinew_resolve`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn resolve(&mut self, name: &str, within_ns: u64) -> Result<Option<u64>, StatusError> {
        let mut tid = MaybeUninit::new(u64::MAX);
        let status = sinew_resolve(self.pointer(), text(name.as_bytes()), within_ns, Some(&mut tid));
        // SAFETY: it was initialized with a value.
        let tid = unsafe { tid.assume_init() };
        if status == Status::SinewNothing {
            assert_eq!(tid, 0, "nobody has the name");
            return Ok(None);
        }
        done(status).map(|()| Some(tid))
    }

    /// `sinew_join_group`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn join(&mut self, name: &str) -> Result<(), StatusError> {
        done(sinew_join_group(self.pointer(), text(name.as_bytes())))
    }

    /// `sinew_leave_group`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn leave(&mut self, name: &str) -> Result<(), StatusError> {
        done(sinew_leave_group(self.pointer(), text(name.as_bytes())))
    }

    /// `sinew_unregister`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn unregister(self) -> Result<(), StatusError> {
        let mut endpoint = self.pointer();
        mem::forget(self);
        done(sinew_unregister(Some(&mut endpoint)))
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        // A destructor cannot return the error.
        let _ = sinew_unregister(Some(&mut self.pointer()));
    }
}

impl Deref for Made {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.payload
    }
}

impl DerefMut for Made {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.payload
    }
}

impl Drop for Made {
    fn drop(&mut self) {
        if self.message.0.token != 0 {
            let owner = ptr::without_provenance_mut(self.owner);
            // Its endpoint may be gone, and the message with it.
            let _ = sinew_discard_message(owner, Some(&mut self.message.0));
        }
    }
}

impl InHand {
    /// The C struct. Do not dereference its `bytes`.
    #[must_use]
    pub const fn fields(&self) -> &message::Received {
        &self.message.0
    }

    /// The payload.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        &self.payload
    }

    /// `sinew_settle_message`.
    ///
    /// # Errors
    /// Those of the C function.
    pub fn settle(mut self, outcome: i32) -> Result<(), StatusError> {
        self.settle_as(outcome)
    }

    fn settle_as(&mut self, outcome: i32) -> Result<(), StatusError> {
        let owner = ptr::without_provenance_mut(self.owner);
        done(sinew_settle_message(owner, Some(&mut self.message.0), outcome))
    }
}

impl Drop for InHand {
    fn drop(&mut self) {
        if self.message.0.token != 0 {
            let outcome = if thread::panicking() { Outcome::SinewFailed } else { Outcome::SinewDelivered };
            // Its endpoint may be gone, which has settled it as Failed.
            let _ = self.settle_as(outcome as i32);
        }
    }
}
