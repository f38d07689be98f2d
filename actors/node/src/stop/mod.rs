//! The stop of the whole system: every node makes its guarded outputs safe, and the application that pressed learns
//! which nodes confirmed that. It is no safety function.
//!
//! ```text
//!  press (application, client) ── node/stop ──► thread `stop` ── Core ── STATE to all nodes, until they have it
//!                                                   └─ latch ◄── outputs of this process read it, without a lock
//! ```
//!
//! | rule | |
//! | --- | --- |
//! | STOP-1 | A press has the node, the incarnation and the number of its origin. A node knows for each origin the highest number that was pressed, and the highest that was released. It is stopped while one of the first is above the second. |
//! | STOP-2 | Two nodes exchange these numbers, and each takes the higher ones. So a press that a release did not know outlasts it, in any order of arrival. |
//! | STOP-3 | A release covers the presses that the releasing node knows, and no others. It has the application that released. A node takes it only if that is an operator by its access list; without a list, if the node is open and on loopback. |
//! | STOP-4 | STATE is sent to each node at once after a change, again each 20 ms for 1 s while the other does not have it, when a node is found, and each 2 s. It is Control, unconfirmed, and lives for 1 s. |
//! | STOP-5 | A node says that it is safe when it is stopped and no output in its process is live or waits for its safe function. Such a STATE that has all presses of the reader is the confirmation. |
//! | STOP-6 | A node that starts is held: no output can be armed until two cycles of NDL and a look at the known nodes have passed, and each present node has sent STATE to this incarnation. A node that finds another one is held until that has sent STATE. Outputs that are live stay so while a node is held. |
//! | STOP-7 | With `node.state` the numbers outlive the node. A file that cannot be read is a press. |
//! | STOP-8 | A stopped node hands over no echo. So the commands of its senders, and to its outputs in other processes, become too old within the limits of their types. In the hold at its start it hands over none of its applications in other processes. After the release it hands over no echo of an application in another process before that has acknowledged the stop. |
//! | STOP-9 | Applications of the node's own user, and of other nodes, may press. Guests may not. Only an application of the node itself may release there. |
//! | STOP-10 | With `stop.on_lost`, a node that loses another one without its farewell presses the stop. |
//!
//! `docs/protocol/stop.md` lists the fields.

mod core;
mod frame;
mod kept;
mod rights;
mod shell;
mod thread;

pub(crate) use thread::begin;
