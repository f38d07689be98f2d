//! The registration of an endpoint, with its options.

use std::{path::PathBuf, time::Duration};

use pyo3::{exceptions::PyValueError, prelude::*};
use sinew_client::{DirectLinks, EventLoop, NodeApi, Registration, Transport};
use sinew_model::facts::NodeEvent;
use sinew_runtime::{app::RequirementEvent, tid::AppAddress};
use sinew_schema::Schema;

use crate::{
    errors,
    operation::{Done, Operation},
    parameters::{ParameterSet, Registered, ToServe},
    seconds,
};

/// Time limit to reach the socket of a node that is trusted only as this user's own, or root's.
const CONNECT_WITHIN: Duration = Duration::from_secs(2);
/// Maximum of `inbox_capacity`.
const INBOX_MAX: usize = 65_536;

/// The options of a registration.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct Options {
    name: Option<String>,
    requires: Vec<String>,
    handles: Vec<NamedType>,
    sends: Vec<NamedType>,
    parameters: Option<(Py<ParameterSet>, f64)>,
    node_events: bool,
    requirement_events: bool,
    deadline: f64,
    stall_timeout: f64,
    inbox_capacity: usize,
    address: Option<u32>,
    socket_only: bool,
    reconnect: bool,
    own_user_only: bool,
    direct: String,
}

/// The name of a type, and the canonical bytes of its structure if that is known.
type NamedType = (String, Option<Vec<u8>>);

impl Options {
    fn registration(self) -> PyResult<Registration> {
        if !(1..=INBOX_MAX).contains(&self.inbox_capacity) {
            let text = format!("inbox_capacity is {}: take 1 to {INBOX_MAX} messages", self.inbox_capacity);
            return Err(PyValueError::new_err(text));
        }
        let mut registration = Registration::new()
            .requires(self.requires)
            .deadline(seconds("deadline", self.deadline)?)
            .stall_timeout(seconds("stall_timeout", self.stall_timeout)?)
            .inbox_capacity(self.inbox_capacity);
        if let Some(name) = self.name {
            registration = registration.name(name);
        }
        if let Some(address) = self.address {
            registration = registration.fixed_address(AppAddress::new(address));
        }
        for (name, structure) in self.handles {
            registration = match structure {
                Some(bytes) => registration.handles_structure(&name, &parsed(&name, &bytes)?),
                None => registration.handles_named(name),
            };
        }
        for (name, structure) in self.sends {
            registration = match structure {
                Some(bytes) => registration.sends_structure(&name, &parsed(&name, &bytes)?),
                None => registration.handles_named(name),
            };
        }
        if self.parameters.is_some() {
            registration = registration.serves_parameters();
        }
        if self.node_events {
            registration = registration.subscribe::<NodeEvent>();
        }
        if self.requirement_events {
            registration = registration.subscribe::<RequirementEvent>();
        }
        registration = registration.direct(match self.direct.as_str() {
            "automatic" => DirectLinks::Automatic,
            "always" => DirectLinks::Always,
            "never" => DirectLinks::Never,
            other => {
                let text = format!("direct is {other:?}: take \"automatic\", \"always\" or \"never\"");
                return Err(PyValueError::new_err(text));
            }
        });
        if self.socket_only {
            registration = registration.transport(Transport::Socket);
        }
        Ok(if self.reconnect { registration } else { registration.without_reconnect() })
    }
}

fn parsed(name: &str, bytes: &[u8]) -> PyResult<Schema> {
    Schema::parse(bytes).map_err(|why| PyValueError::new_err(format!("the structure of {name}: {why}")))
}

/// Begins a registration at the node with this socket. The result is a `Core`.
#[pyfunction]
pub(crate) fn register(py: Python<'_>, socket: PathBuf, options: Options) -> PyResult<Operation> {
    let own_user_only = options.own_user_only;
    let parameters = match &options.parameters {
        Some((set, period)) => Some(ToServe::new(set.get(), seconds("period", *period)?)),
        None => None,
    };
    let registration = options.registration()?;
    let events = EventLoop::new()?;
    let connected = py.detach(|| {
        if own_user_only {
            NodeApi::connect_trusted(socket, CONNECT_WITHIN)
        } else {
            NodeApi::connect(socket)
        }
    });
    let node = connected.map_err(|error| errors::api(py, &error))?;
    let of_endpoint = events.clone();
    let future = async move {
        let endpoint = node.register_transport_address_on(registration, of_endpoint).await?;
        Ok(Done::Registered(Box::new(Registered::new(endpoint, parameters.as_ref()))))
    };
    Ok(Operation::new(Box::pin(future), events))
}
