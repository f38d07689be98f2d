//! Sessions of zenoh that use named routers alone: no multicast, no gossip.

use std::{fmt, time::Duration};

use zenoh::{Config, Session, Wait, qos::Priority};

use crate::config::Tls;

/// Keep-alive messages in one lease.
const KEEP_ALIVES: u32 = 4;
/// Wait before a router is tried again; it doubles up to the longest one.
const RETRY_FIRST_MS: u32 = 100;
const RETRY_LONGEST_MS: u32 = 1_000;
/// Maximum bytes of a received message. Packets of the device have at most 64 KiB.
const MESSAGE_MAX: u32 = 131_072;

/// The cause for which there is no session.
#[derive(Debug)]
pub struct SessionError(String);

impl fmt::Display for SessionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "zenoh: {}", self.0)
    }
}

impl std::error::Error for SessionError {}

impl From<zenoh::Error> for SessionError {
    fn from(error: zenoh::Error) -> Self {
        Self(error.to_string())
    }
}

/// The part of a session in the network.
#[derive(Clone, Copy, Debug)]
pub enum Role<'a> {
    /// A client of one of these routers at a time. It waits until one accepts it.
    Client {
        /// Endpoints of the routers.
        routers: &'a [String],
        /// Certificates for them.
        tls: &'a Tls,
    },
    /// A router at these endpoints, connected with others.
    Router {
        /// Own endpoints.
        listen: &'a [String],
        /// Endpoints of other routers.
        connect: &'a [String],
    },
    /// A bridge for programs that speak Zenoh: a client of one router at a time, or a peer.
    Bridge(Bridge<'a>),
}

/// The settings of a bridge's session.
#[derive(Clone, Copy, Debug)]
pub struct Bridge<'a> {
    /// Whether it is a peer. A client waits until a router accepts it.
    pub is_peer: bool,
    /// Own endpoints.
    pub listen: &'a [String],
    /// Endpoints of routers and peers.
    pub connect: &'a [String],
    /// Whether peers are searched for by multicast.
    pub scouting: bool,
    /// The keys of `transport/link/tls`, and the paths of PEM files.
    pub certificates: &'a [(&'a str, &'a str)],
    /// Maximum bytes of a received message.
    pub message_max: u32,
}

/// Opens a session.
///
/// # Errors
/// Returns zenoh's error: an endpoint or certificate that it does not accept, or a taken port.
pub fn open(role: Role<'_>, lease: Duration) -> Result<Session, SessionError> {
    let mut config = Config::default();
    let mut insert = |key: &str, value: String| {
        config.insert_json5(key, &value).map_err(|error| SessionError(format!("{key} = {value}: {error}")))
    };
    let (mut scouting, mut message_max) = (false, MESSAGE_MAX);
    let (mode, listen, connect) = match role {
        Role::Client { routers, tls } => {
            let files = [
                ("root_ca_certificate", &tls.root_ca_certificate),
                ("connect_certificate", &tls.connect_certificate),
                ("connect_private_key", &tls.connect_private_key),
            ];
            for (key, path) in files.into_iter().filter_map(|(key, path)| Some((key, path.as_ref()?))) {
                insert(&format!("transport/link/tls/{key}"), text(path))?;
            }
            let mutual = tls.connect_certificate.is_some();
            insert("transport/link/tls/enable_mtls", mutual.to_string())?;
            ("client", &[][..], routers)
        }
        Role::Router { listen, connect } => ("router", listen, connect),
        Role::Bridge(bridge) => {
            for (key, path) in bridge.certificates {
                insert(&format!("transport/link/tls/{key}"), text(path))?;
            }
            let has = |wanted: &str| bridge.certificates.iter().any(|(key, _)| *key == wanted);
            // A listener with an authority of its own admits certificates of that authority alone.
            let mutual =
                has("connect_certificate") || has("listen_certificate") && has("root_ca_certificate");
            insert("transport/link/tls/enable_mtls", mutual.to_string())?;
            (scouting, message_max) = (bridge.scouting, bridge.message_max);
            (if bridge.is_peer { "peer" } else { "client" }, bridge.listen, bridge.connect)
        }
    };
    insert("mode", text(mode))?;
    insert("listen/endpoints", list(listen))?;
    insert("connect/endpoints", list(connect))?;
    insert("connect/timeout_ms", "-1".to_owned())?;
    insert("connect/exit_on_failure", "false".to_owned())?;
    let retry = format!(
        "{{ period_init_ms: {RETRY_FIRST_MS}, period_max_ms: {RETRY_LONGEST_MS}, period_increase_factor: 2 }}"
    );
    insert("connect/retry", retry)?;
    insert("scouting/multicast/enabled", scouting.to_string())?;
    insert("scouting/gossip/enabled", "false".to_owned())?;
    insert("transport/link/tx/lease", lease.as_millis().to_string())?;
    insert("transport/link/tx/keep_alive", KEEP_ALIVES.to_string())?;
    insert("transport/link/rx/max_message_size", message_max.to_string())?;
    Ok(zenoh::open(config).wait()?)
}

/// Returns zenoh's priority of a class.
#[must_use]
pub const fn priority(class: sinew_zenoh_link::Class) -> Priority {
    use sinew_zenoh_link::Class;
    match class {
        Class::Discovery => Priority::RealTime,
        Class::Control => Priority::InteractiveHigh,
        Class::Stream => Priority::InteractiveLow,
        Class::Unmarked => Priority::Data,
        Class::Bulk => Priority::Background,
    }
}

/// Returns a text as a value of JSON.
fn text(value: &str) -> String {
    let mut quoted = String::with_capacity(value.len() + 2);
    quoted.push('"');
    for character in value.chars() {
        if matches!(character, '"' | '\\') {
            quoted.push('\\');
        }
        quoted.push(character);
    }
    quoted.push('"');
    quoted
}

fn list(values: &[String]) -> String {
    let values: Vec<_> = values.iter().map(|value| text(value)).collect();
    format!("[{}]", values.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_values_of_json() {
        assert_eq!(text("tcp/[::1]:7447"), "\"tcp/[::1]:7447\"");
        assert_eq!(text("a\"b\\c"), "\"a\\\"b\\\\c\"");
        assert_eq!(list(&["a".to_owned(), "b".to_owned()]), "[\"a\", \"b\"]");
    }
}
