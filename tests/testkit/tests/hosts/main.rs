//! Packets between hosts: forwarded or dropped by the bridge, lost or delayed by the radio.

mod bridge;
mod radio;
