//! A powered leg as pure state machines: the person's gait, the leg, the cores of sensors, drives and central
//! unit, the datagrams of the devices, and the figures of a walk.
//!
//! Time is an argument, random numbers come from a seed, and no core uses a clock, a socket or a thread. The
//! nodes of the example `exoskeleton` wrap these cores as applications; [`lockstep`] runs them in one thread
//! on virtual time. Only [`message`] depends on Sinew: it declares how each message is sent.
//!
//! It is a simulation and claims nothing clinical; the software e-stop is not a safety function.

pub mod central;
pub mod chance;
pub mod control;
pub mod datagram;
pub mod gait;
pub mod intention;
pub mod joint;
pub mod leg;
pub mod lockstep;
pub mod message;
pub mod metrics;
pub mod part;
pub mod phase;
pub mod plant;
pub mod record;
pub mod sensor;
pub mod strides;
