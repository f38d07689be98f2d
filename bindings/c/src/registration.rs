//! Registers and unregisters an address.

use std::mem::MaybeUninit;

use sinew_client::NodeApi;

use crate::{
    ffi_boundary::{call, present, value, write},
    fork, log,
    message::{Endpoint, TidBits},
    options::Options,
    session::Session,
    status::{CallError, Status},
    table::ENDPOINTS,
    text::Text,
};

/// The version of this header's structs and functions. It grows when programs must be recompiled, counted
/// from the release 0.1.0 on.
pub const SINEW_ABI: u32 = 1;

/// Gives the `SINEW_ABI` that the library was built with. Any thread.
///
/// A program that is compiled with this header need not compare: its registration is rejected if the two
/// differ. A program that loads the functions by their names, or registers no endpoint, has to compare by
/// itself.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_abi() -> u32 {
    SINEW_ABI
}

/// Connects to the node with `lncl.socket` = `socket` in its configuration, requests a transport address, and
/// waits until all requirements are ready (the paper's RegisterTransportAddress). `options` may be NULL: a
/// dynamic address, no name. Any thread, any number at the same time. Blocks at most until the deadline of
/// the options.
///
/// One thread at a time may use the endpoint. A process may have 256, if its node allows it:
/// `lncl.clients_per_process_max`, 64.
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
            sinew_client::Registration::new()
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

/// Registers as `sinew_register_transport_address` does, for a program that was compiled with the header of
/// this `abi`. That function is a macro in C and C++, which calls this one with `SINEW_ABI`.
/// `SINEW_ERROR_INVALID_ARGUMENT` if the library has another: the shared structs may differ, and none of them
/// was read. Any thread. Blocks as that does.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_register_with_abi(
    abi: u32,
    socket: Text,
    options: *const Options,
    endpoint: Option<&mut MaybeUninit<*mut Endpoint>>,
) -> Status {
    if abi == SINEW_ABI {
        return sinew_register_transport_address(socket, options, endpoint);
    }
    call(|| {
        Err(CallError::argument(format!(
            "the program was compiled with a sinew.h of SINEW_ABI {abi}, and this library has SINEW_ABI {SINEW_ABI}; compile the program \
             with the sinew.h of this library, or install the library of that sinew.h"
        )))
    })
}

/// Unregisters the address, and waits at most 2 s until the node has released it: then the name is free. The
/// endpoint is gone and `*endpoint` is NULL with every result except `SINEW_ERROR_BUSY` and
/// `SINEW_ERROR_FORKED`. Received messages that were not settled end as Failed; a message that was created
/// and not sent is discarded; the memory of both is freed. The endpoint's thread, or any other one while no
/// call on it is running.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_unregister(endpoint: Option<&mut *mut Endpoint>) -> Status {
    call(|| {
        let endpoint = endpoint.ok_or_else(|| CallError::plain(Status::SinewErrorNoSuchEndpoint))?;
        let session = ENDPOINTS.take(endpoint.addr())?;
        *endpoint = std::ptr::null_mut();
        session.unregister().map(|()| Status::SinewOk)
    })
}

/// Gives the address that was registered; 0 if this is no endpoint or another thread is in a call on it. The
/// endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_endpoint_tid(endpoint: *const Endpoint) -> TidBits {
    value(0, || with(endpoint, |session| Ok(session.endpoint().tid().bits())))
}

/// Gives the length of the longest payload that the node accepts, in bytes; 0 if this is no endpoint or
/// another thread is in a call on it. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_payload_max(endpoint: *const Endpoint) -> usize {
    value(0, || with(endpoint, |session| Ok(session.endpoint().payload_max())))
}

/// Gives the name of the node, terminated by a zero and valid until the endpoint is unregistered; NULL if
/// this is no endpoint or another thread is in a call on it. The endpoint's thread; the text may be read by
/// any.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_node_name(endpoint: *const Endpoint) -> *const std::ffi::c_char {
    value(std::ptr::null(), || with(endpoint, |session| Ok(session.node_name().as_ptr())))
}

/// Calls `body` with the session of an endpoint.
pub(crate) fn with<R>(
    endpoint: *const Endpoint,
    body: impl FnOnce(&mut Session) -> Result<R, CallError>,
) -> Result<R, CallError> {
    ENDPOINTS.with(endpoint.addr(), body)
}
