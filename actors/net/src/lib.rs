//! The network interfaces of this host and their addresses, as the kernel reports them (rtnetlink,
//! rtnetlink(7)).
//!
//! | module | content |
//! | --- | --- |
//! | `report` | the decoding of one message of the kernel |
//! | `table` | the known addresses, and the losses; pure |
//! | `monitor` | the subscription to the kernel's reports |
//!
//! GNCL cuts connections over lost addresses, NDL opens sockets at new ones. Each has a monitor of its own,
//! as they wait in different ways.

mod monitor;
mod report;
mod table;

pub use monitor::InterfaceMonitor;
pub use report::Ipv6Flags;
pub use table::InterfaceAddress;
