//! The readiness of a program that its node supervises.

use std::pin::pin;

use sinew_runtime::wire::{Header, Kind, Message};

use super::{Endpoint, LNCL};
use crate::{ApiError, wait_mode::block_ready};

impl Endpoint {
    /// Reports to the node that this program is ready. Has an effect only if the node has started the program as a
    /// command with the readiness `Called`; all other programs are ready when they have registered.
    ///
    /// # Errors
    /// The node does not accept the message.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::{NodeApi, Registration};
    ///
    /// let node = NodeApi::connect(std::env::var("SINEW_SOCKET")?)?;
    /// let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
    /// let device = std::fs::File::open("/dev/ttyUSB0")?;
    /// // Applications that require this one start now.
    /// drive.ready()?;
    /// # drop(device);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn ready(&mut self) -> Result<(), ApiError> {
        block_ready(pin!(self.send_ready()))
    }

    pub(crate) async fn send_ready(&mut self) -> Result<(), ApiError> {
        if !self.awaits_ready {
            return Ok(());
        }
        let ready = Message::new(Header::new(Kind::LNCL_READY, self.tid, LNCL), bytes::Bytes::new());
        self.dispatch(ready.into(), self.stall_timeout()).await.map(drop)
    }
}
