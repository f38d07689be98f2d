//! Looks up applications by name at the node.

use std::{pin::pin, time::Duration};

use sinew_protocol::payload::{self, Resolve};
use sinew_runtime::{
    tid::Tid,
    time::Time,
    wire::{Flags, Kind},
};

use super::{Endpoint, LNCL};
use crate::{
    ApiError,
    inbox::{Answer, Awaited},
    wait_mode::block_ready,
};

/// Minimum interval between requests for names similar to an unknown one.
const NEAREST_INTERVAL: Duration = Duration::from_secs(1);

impl Endpoint {
    /// Returns the TID of the application that has `name` now, on any node, or `None`.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Tid, client::ApiError};
    ///
    /// fn find_knee(endpoint: &mut Endpoint) -> Result<Option<Tid>, ApiError> {
    ///     endpoint.resolve("knee.drive", Duration::from_millis(100))
    /// }
    /// ```
    pub fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        block_ready(pin!(self.look_up(name, within)))
    }

    pub(crate) async fn look_up(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        let asked = Resolve { name: name.to_owned(), nearest: false };
        self.ask_for_name(&asked, within).await.map(|(tid, _)| tid)
    }

    /// Returns the TID of a name for a send. If no application has the name, the error lists similar names,
    /// at most once per [`NEAREST_INTERVAL`]. The search costs the node time, and a loop may send to an
    /// application that is down.
    pub(crate) async fn find_named(&mut self, name: &str, within: Duration) -> Result<Tid, ApiError> {
        let now = Time::now();
        let nearest = self.nearest_asked.is_none_or(|asked| now.since(asked) >= NEAREST_INTERVAL);
        let asked = Resolve { name: name.to_owned(), nearest };
        let (tid, nearest) = self.ask_for_name(&asked, within).await?;
        if tid.is_none() && asked.nearest {
            self.nearest_asked = Some(now);
        }
        tid.ok_or(ApiError::UnknownName { name: asked.name, nearest })
    }

    async fn ask_for_name(
        &mut self,
        asked: &Resolve,
        within: Duration,
    ) -> Result<(Option<Tid>, Vec<String>), ApiError> {
        let message = payload::frame(Kind::LNCL_RESOLVE, self.tid, LNCL, asked);
        match self.request(message.into(), Awaited::Resolved, Flags::NONE, within).await? {
            Some(Answer::Resolved(tid, nearest)) => Ok((tid, nearest)),
            Some(Answer::Outcome(_) | Answer::Members(_) | Answer::Reply(_)) | None => {
                Err(ApiError::NoAnswer(within))
            }
        }
    }
}
