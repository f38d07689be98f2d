//! NodeAPI: for applications in processes of their own.
//!
//! A program connects to the node on its host through the node's unix socket, registers one or more transport
//! addresses (*endpoints*), and sends and receives on them. Its forms have the same semantics,
//! stated in `docs/book/src/reference/guarantees.md`:
//!
//! | your program is | its form | start with |
//! | --- | --- | --- |
//! | a plain thread, as of a control loop; no async runtime | [`Endpoint`] | [`NodeApi::register_transport_address`] |
//! | a task of tokio | [`AsyncEndpoint`] | [`NodeApi::register_transport_address_async`] |
//! | a task of another event loop | [`AsyncEndpoint`], [`EventLoop`] | [`NodeApi::register_transport_address_on`] |
//! | in C or C++ | `sinew.h`, `sinew.hpp` | `bindings/c/README.md` |
//!
//! # Operations
//!
//! Both Rust forms use the same names. You send a type of your own (`payload!`) or, with
//! `_message` in the name, raw bytes.
//!
//! | to | Rust | C |
//! | --- | --- | --- |
//! | get an address, with a name, and give it back (RegisterTransportAddress) | [`Registration`], [`unregister`](Endpoint::unregister) or drop | `sinew_register_transport_address`, `sinew_unregister` |
//! | find an application by name, on any node | [`resolve`](Endpoint::resolve), [`Registration::requires`] | `sinew_resolve` |
//! | send without a confirmation | [`send`](Endpoint::send) | `sinew_send_bytes` |
//! | receive the outcome (confirm) | [`message`](Endpoint::message)`(to, &value)`[`.confirmed(within)`](MessageBuilder::confirmed): one [`Outcome`](sinew_runtime::outcome::Outcome) | `sinew_send_message_confirmed` |
//! | ask, and wait for the reply | [`ask`](MessageBuilder::ask) of a message, [`reply`](Endpoint::reply) | `sinew_ask`, `sinew_reply` |
//! | limit the wait for room to 200 us, or to zero | [`room_within`](MessageBuilder::room_within) of a message | `sinew_room_within` of a message |
//! | write a payload in place, so that sending it copies nothing (loan: CreateMessage, SendMessage) | [`create_message`](Endpoint::create_message), [`LoanedMessage`], [`loaned`](Endpoint::loaned) | `sinew_create_message`, `sinew_send_message` |
//! | receive, with a deadline (ReceiveMessage) | [`receive`](Endpoint::receive), [`Received`] | `sinew_receive_message`, `sinew_settle_message` |
//! | receive the outcome at each member of a group | [`.confirmed_by_each(within)`](MessageBuilder::confirmed_by_each): a [`MemberOutcome`](sinew_runtime::outcome::MemberOutcome) for each | `sinew_send_message_confirmed_by_each` |
//! | send to many at once (groups) | [`join`](Endpoint::join), [`leave`](Endpoint::leave), [`Tid::group`](sinew_runtime::tid::Tid::group) | `sinew_join_group`, `sinew_group` |
//! | take only the newest value of a sensor | [`Class::Stream`](sinew_runtime::wire::Class), at the type | `SINEW_STREAM` |
//! | protect commands from end to end, and make an output safe without them ([`protection`](sinew_runtime::protection)) | [`Endpoint::guard`] | not there: `bindings/c/README.md` |
//! | receive events of nodes that connect and leave | [`Registration::subscribe`] | `events` of `sinew_options` |
//! | continue after a restart of the node | nothing to do; [`ApiError::Disconnected`] reports it once | `SINEW_ERROR_DISCONNECTED` |
//! | the shortest way to another process | [`Registration::direct`], [`Registration::spin`] | `SINEW_DIRECT_ALWAYS`, `spin_ns` |
//! | get an error's details | [`ApiError`]: cause, place, remedy | `sinew_last_error` |
//!
//! # A thread
//!
//! ```
//! use std::time::Duration;
//!
//! use sinew::{NodeApi, Registration, client::ApiError};
//!
//! sinew::payload!("demo.joint_angle", Stream => struct JointAngle { degrees: f32 });
//! sinew::payload!("demo.limit" => struct Limit { degrees: f32 });
//!
//! # let path = std::env::temp_dir().join(format!("sinew-doc-thread-{}.sock", std::process::id()));
//! # let mut builder = sinew::Node::builder("knee");
//! # builder = builder.configure(|config| {
//! #     (config.lncl.socket, config.ndl.multicast, config.ndl.mdns_port) = (Some(path.clone()), None, None);
//! # });
//! # let _node = builder.start().expect("a node for this example");
//! # let path = path.to_str().expect("a short path");
//! let node = NodeApi::connect(path)?; // the `lncl.socket` of the node, as "/run/sinew/knee.sock"
//! let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
//! let mut sensor = node.register_transport_address(Registration::new().requires(["knee.drive"]))?;
//! let second = Duration::from_secs(1);
//!
//! // The sensor finds the drive, and sends it an angle; if there is no room now, it is skipped.
//! let to = sensor.resolve("knee.drive", second)?.expect("it is registered");
//! match sensor.message(to, &JointAngle { degrees: 12.5 }).room_within(Duration::ZERO).send() {
//!     Ok(()) | Err(ApiError::Stalled(_)) => {}
//!     Err(other) => return Err(other),
//! }
//!
//! // The drive receives it. The message counts as handled when `received` goes out of scope.
//! let received = drive.receive(second)?.expect("an angle");
//! assert_eq!(received.decode::<JointAngle>()?.degrees, 12.5);
//!
//! // The drive sends its limit to the sensor, as raw bytes written in place.
//! let mut limit = drive.create_message(received.source(), sinew::message::Kind::named("demo.raw"), 4)?;
//! limit.copy_from_slice(&90_f32.to_le_bytes());
//! drive.loaned(limit).send()?;
//! assert_eq!(sensor.receive(second)?.expect("the limit").bytes(), 90_f32.to_le_bytes());
//! # Ok::<(), ApiError>(())
//! ```
//!
//! # A task
//!
//! ```
//! use std::time::Duration;
//!
//! use sinew::{NodeApi, Outcome, Registration, client::ApiError};
//!
//! sinew::payload!("demo.torque" => #[derive(Debug, PartialEq)] struct Torque { newton_metres: f32 });
//!
//! # let path = std::env::temp_dir().join(format!("sinew-doc-task-{}.sock", std::process::id()));
//! # let mut builder = sinew::Node::builder("hip");
//! # builder = builder.configure(|config| {
//! #     (config.lncl.socket, config.ndl.multicast, config.ndl.mdns_port) = (Some(path.clone()), None, None);
//! # });
//! # let _node = builder.start().expect("a node for this example");
//! # let path = path.to_str().expect("a short path");
//! # let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
//! # runtime.block_on(async {
//! let node = NodeApi::connect(path)?;
//! let mut drive = node.register_transport_address_async(Registration::new().name("hip.drive")).await?;
//! let mut control = node.register_transport_address_async(Registration::new()).await?;
//! let (second, to) = (Duration::from_secs(1), drive.tid());
//!
//! let driving = async {
//!     // The first is confirmed at the end of its scope, the second is a request.
//!     drop(drive.receive().await?);
//!     let request = drive.receive().await?;
//!     let Torque { newton_metres } = request.decode()?;
//!     drive.reply(&request, &Torque { newton_metres: newton_metres / 2.0 }).await
//! };
//! let controlling = async {
//!     let outcome = control.message(to, &Torque { newton_metres: 3.0 }).confirmed(second).await?;
//!     assert_eq!(outcome, Outcome::Delivered);
//!     control.message(to, &Torque { newton_metres: 3.0 }).ask::<Torque>(second).await
//! };
//! let (driven, given) = tokio::join!(driving, controlling);
//! driven?;
//! assert_eq!(given?, Torque { newton_metres: 1.5 });
//! # Ok::<(), ApiError>(())
//! # })?;
//! # Ok::<(), ApiError>(())
//! ```
//!
//! # C
//!
//! This is `bindings/c/examples/hello.c`, which the tests compile and run; `bindings/c/README.md` has the
//! commands for it. `greeter.c` in the same directory is its peer. C++ has a wrapper with scopes and
//! exceptions.
//!
//! ```c
//! /* Waits for the application "greeter", sends its own name to it, and prints the reply:  hello SOCKET */
//! #include <sinew.h>
//! #include <stdio.h>
//! #include <stdlib.h>
//!
//! #define TEN_SECONDS UINT64_C(10000000000)
//!
//! static sinew_status check(sinew_status status)
//! {
//!     if (status < 0) {
//!         fprintf(stderr, "hello: %s\n", sinew_last_error());
//!         exit(EXIT_FAILURE);
//!     }
//!     return status;
//! }
//!
//! int main(int argc, char **argv)
//! {
//!     const sinew_text name = SINEW_TEXT("greeter");
//!     const sinew_options options = { .size = sizeof options, .required = &name, .required_count = 1,
//!                                     .deadline_ns = TEN_SECONDS };
//!     sinew_endpoint *endpoint;
//!     sinew_message message;
//!     sinew_received reply;
//!     sinew_tid greeter;
//!     check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint));
//!     if (check(sinew_resolve(endpoint, name, TEN_SECONDS, &greeter)) == SINEW_NOTHING) {
//!         fprintf(stderr, "hello: the greeter was there, and has gone\n");
//!         return EXIT_FAILURE;
//!     }
//!     check(sinew_create_message(endpoint, greeter, sinew_kind_named(SINEW_TEXT("demo.name")), SINEW_CONTROL, 5, &message));
//!     memcpy(message.bytes, "Ankle", 5); /* in the memory from which it is read */
//!     check(sinew_ask(endpoint, &message, TEN_SECONDS, &reply, NULL)); /* whatever this returns, the message is gone */
//!     printf("%.*s\n", (int)reply.length, (const char *)reply.bytes);
//!     check(sinew_settle_message(endpoint, &reply, SINEW_DELIVERED));
//!     check(sinew_unregister(&endpoint));
//!     return EXIT_SUCCESS;
//! }
//! ```
//!
//! The protocol underneath is `docs/protocol/lncl.md`; any language can implement it.

mod async_endpoint;
mod barrier;
mod builder;
mod direct;
mod direct_links;
mod dispatch;
mod endpoint;
mod error;
mod event_loop;
mod inbox;
mod incoming;
mod link;
mod loan;
mod node_api;
mod node_link;
mod only_message;
mod outgoing;
mod parameters;
mod protected;
mod reactor;
mod received;
mod reconnect;
mod registration;
mod requests;
/// The core of direct links alone, for its simulation.
#[doc(hidden)]
pub mod routes;
mod stall_timeout;
mod stop;
#[cfg(test)]
mod tests;
mod transaction;
mod undelivered;
mod wait_mode;

pub use async_endpoint::AsyncEndpoint;
pub use barrier::{Barrier, BarrierError, Meet, Meeting};
pub use builder::{MessageBuilder, Value};
pub use direct_links::DirectLinks;
pub use endpoint::Endpoint;
pub use error::ApiError;
pub use event_loop::EventLoop;
pub use link::Transport;
pub use loan::LoanedMessage;
pub use node_api::NodeApi;
pub use parameters::EndpointParameters;
pub use received::Received;
pub use registration::Registration;
pub use sinew_shm::Spin;
pub use transaction::SetTogetherError;
