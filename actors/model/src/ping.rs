//! The sign of life of an application.

use serde::{Deserialize, Serialize};
use sinew_runtime::wire::Payload;

/// Asks for a sign of life, confirmed: the receiver need not know this type.
///
/// # Examples
///
/// ```
/// use sinew::{Endpoint, Outcome, Tid, client::ApiError, inspect::Ping, prelude::*};
///
/// fn lives(endpoint: &mut Endpoint, app: Tid) -> Result<bool, ApiError> {
///     let outcome = endpoint.message(app, &Ping {}).confirmed(Duration::from_millis(100))?;
///     Ok(outcome == Outcome::Delivered)
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Ping {}

impl Payload for Ping {
    const NAME: &'static str = "sinew.ping";
}
