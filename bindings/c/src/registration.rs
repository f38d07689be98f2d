//! An address is asked for, and given back.

use std::mem::MaybeUninit;

use sinew::NodeApi;

use crate::{
    border::{call, present, value, write},
    fork, log,
    message::{Endpoint, TidBits},
    options::Options,
    session::Session,
    status::{Fault, Status},
    table::ENDPOINTS,
    text::Text,
};

/// The version of this header's structs and functions. It grows when a program must be compiled anew.
pub const SINEW_ABI: u32 = 1;

/// The `SINEW_ABI` that the library was built with. A program that loads the library at run time compares. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_abi() -> u32 {
    SINEW_ABI
}

/// Connects to the node whose configuration's `lncl.socket` is `socket`, asks for a transport address, and waits until
/// everything that is required is ready (the paper's RegisterTransportAddress). `options` may be NULL: a dynamic address,
/// no name. Any thread, any number at the same time. Blocks until the deadline of the options at most.
///
/// The endpoint is one thread's at a time. A process may have 256, if its node lets it: `lncl.clients_per_process_max`, 64.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_register_transport_address(
    socket: Text,
    options: *const Options,
    endpoint: Option<&mut MaybeUninit<*mut Endpoint>>,
) -> Status {
    call(|| {
        log::begin();
        let endpoint = present(endpoint, "endpoint")?;
        let path = socket.path("socket")?;
        let registration = if options.is_null() {
            sinew::Registration::new()
        } else {
            Options::read(options)?.registration()?
        };
        fork::watch()?;
        let claim = ENDPOINTS.claim()?;
        let registered = NodeApi::connect(path)?.register_transport_address(registration)?;
        let handle = claim.fill(Session::new(registered));
        Ok(write(endpoint, std::ptr::without_provenance_mut(handle)))
    })
}

/// Gives the address back, and waits until the node has taken it, 2 s at most: then the name is free. Whatever it returns,
/// but for `SINEW_ERROR_BUSY` and `SINEW_ERROR_FORKED`, the endpoint is gone and `*endpoint` is NULL. Messages that were
/// received and not settled end as Failed; one that was made and not sent is discarded; the memory of both is gone. The
/// endpoint's thread, or any when no other one is in a call on it.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_unregister(endpoint: Option<&mut *mut Endpoint>) -> Status {
    call(|| {
        let endpoint = endpoint.ok_or_else(|| Fault::plain(Status::SinewErrorNoSuchEndpoint))?;
        let session = ENDPOINTS.take(endpoint.addr())?;
        *endpoint = std::ptr::null_mut();
        session.unregister().map(|()| Status::SinewOk)
    })
}

/// The address that was registered; 0 if this is no endpoint or another thread is in a call on it. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_endpoint_tid(endpoint: *const Endpoint) -> TidBits {
    value(0, || with(endpoint, |session| Ok(session.endpoint().tid().bits())))
}

/// Longest payload that the node takes, in bytes; 0 if this is no endpoint or another thread is in a call on it. The
/// endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_payload_max(endpoint: *const Endpoint) -> usize {
    value(0, || with(endpoint, |session| Ok(session.endpoint().payload_max())))
}

/// The name of the node, ended by a zero, until the endpoint is unregistered; NULL if this is no endpoint or another thread
/// is in a call on it. The endpoint's thread; what it points to, any.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_node_name(endpoint: *const Endpoint) -> *const std::ffi::c_char {
    value(std::ptr::null(), || with(endpoint, |session| Ok(session.node_name().as_ptr())))
}

/// Does something with an endpoint of C's.
pub(crate) fn with<R>(
    endpoint: *const Endpoint,
    body: impl FnOnce(&mut Session) -> Result<R, Fault>,
) -> Result<R, Fault> {
    ENDPOINTS.with(endpoint.addr(), body)
}
