//! An endpoint: each call begins one operation, which Python polls.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use pyo3::{exceptions::PyValueError, prelude::*, pybacked::PyBackedBytes};
use sinew_client::{ApiError, AsyncEndpoint, Barrier, EventLoop, LoanedMessage, MessageBuilder};
use sinew_model::barrier::OnPartyLoss;
use sinew_runtime::{
    outcome::Outcome,
    parameters::NamedValue,
    tid::Tid,
    wire::{Class, Kind},
};

use crate::{
    errors,
    fork::Owner,
    guard::{OutputGuard, ProtectedType, check_may_guard, safe_function},
    lease::{Facts, Lease},
    operation::{Done, Failure, Operation, Running, gone},
    parameters::{AnyValue, Registered},
    received::Received,
    seconds,
};

/// Time limit for the node's answer to a name, if the message has no shorter one.
const NAMED_WITHIN: Duration = Duration::from_secs(1);
/// A report of undelivered messages: destination, its name, kind, the code of the reason, count.
type UndeliveredTuple = (u64, Option<String>, Option<u32>, u8, u64);

/// A destination: the bits of a TID, or a name.
#[derive(FromPyObject)]
pub(crate) enum To {
    Tid(u64),
    Name(String),
}

/// A message to send: destination, kind, class, payload, seconds to wait for room, seconds until it expires.
#[derive(FromPyObject)]
pub(crate) struct Outgoing(To, u32, u8, PyBackedBytes, Option<f64>, Option<f64>);

/// The same, checked.
struct Draft {
    to: To,
    kind: Kind,
    class: Class,
    payload: PyBackedBytes,
    room_within: Option<Duration>,
    expires_after: Option<Duration>,
}

impl Outgoing {
    fn check(self) -> PyResult<Draft> {
        let Self(to, kind, class, payload, room, expires) = self;
        Ok(Draft {
            to,
            kind: Kind::from_bits(kind),
            class: class_of(class)?,
            payload,
            room_within: room.map(|room| seconds("room_within", room)).transpose()?,
            expires_after: expires.map(|expires| seconds("expires_after", expires)).transpose()?,
        })
    }
}

/// Returns the class with this number.
pub(crate) fn class_of(number: u8) -> PyResult<Class> {
    match number {
        0 => Ok(Class::Control),
        1 => Ok(Class::Stream),
        2 => Ok(Class::Bulk),
        _ => Err(PyValueError::new_err(format!("no class of messages has the number {number}"))),
    }
}

impl To {
    async fn find(&self, endpoint: &mut AsyncEndpoint, within: Duration) -> Result<Tid, ApiError> {
        match self {
            Self::Tid(bits) => Ok(Tid::from_bits(*bits)),
            Self::Name(name) => endpoint
                .resolve(name, within)
                .await?
                .ok_or_else(|| ApiError::UnknownName { name: name.clone(), nearest: Vec::new() }),
        }
    }
}

impl Draft {
    /// Returns the message in the ring's memory, if it has room.
    async fn builder<'e>(
        &self,
        endpoint: &'e mut AsyncEndpoint,
    ) -> Result<MessageBuilder<'e, AsyncEndpoint, LoanedMessage>, ApiError> {
        let within = self.room_within.map_or(NAMED_WITHIN, |room| room.min(NAMED_WITHIN));
        let to = self.to.find(endpoint, within).await?;
        self.builder_to(endpoint, to)
    }

    fn builder_to<'e>(
        &self,
        endpoint: &'e mut AsyncEndpoint,
        to: Tid,
    ) -> Result<MessageBuilder<'e, AsyncEndpoint, LoanedMessage>, ApiError> {
        let mut lent = endpoint.create_message(to, self.kind, self.payload.len())?;
        lent.copy_from_slice(&self.payload);
        let mut builder = endpoint.loaned(lent).class(self.class);
        if let Some(room) = self.room_within {
            builder = builder.room_within(room);
        }
        if let Some(expires) = self.expires_after {
            builder = builder.expires_after(expires);
        }
        Ok(builder)
    }
}

/// An endpoint. One operation at a time.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct Core {
    /// `None` once it is unregistered.
    endpoint: Arc<tokio::sync::Mutex<Option<Registered>>>,
    events: EventLoop,
    facts: Arc<Mutex<Facts>>,
    owner: Owner,
}

fn busy(py: Python<'_>) -> PyErr {
    let text = "another call on this endpoint is under way; register one endpoint for each thread";
    errors::named(py, "BusyError", text)
}

impl Core {
    pub(crate) fn new(registered: Registered, events: EventLoop) -> Self {
        let facts = Arc::new(Mutex::new(Facts::of(&registered.endpoint)));
        let endpoint = Arc::new(tokio::sync::Mutex::new(Some(registered)));
        Self { endpoint, events, facts, owner: Owner::this_process() }
    }

    fn lease(&self, py: Python<'_>) -> PyResult<Lease> {
        if self.owner.is_parent() {
            let text = "the endpoint belongs to the process that this one was forked from; register another one here";
            return Err(errors::named(py, "ForkedError", text));
        }
        let endpoint = Arc::clone(&self.endpoint).try_lock_owned().map_err(|_| busy(py))?;
        if endpoint.is_none() {
            return Err(gone(py));
        }
        Ok(Lease { endpoint, facts: Arc::clone(&self.facts) })
    }

    /// Begins an operation.
    fn begin<M>(&self, py: Python<'_>, make: M) -> PyResult<Operation>
    where
        M: for<'e> FnOnce(&'e mut AsyncEndpoint) -> Running<'e> + Send + 'static,
    {
        self.begin_with_parameters(py, move |registered| make(&mut registered.endpoint))
    }

    /// Begins an operation that needs the parameters, too.
    fn begin_with_parameters<M>(&self, py: Python<'_>, make: M) -> PyResult<Operation>
    where
        M: for<'e> FnOnce(&'e mut Registered) -> Running<'e> + Send + 'static,
    {
        let mut lease = self.lease(py)?;
        let future = async move {
            match &mut *lease {
                Some(registered) => make(registered).await,
                None => Err(Failure::Gone),
            }
        };
        Ok(Operation::new(Box::pin(future), self.events.clone()))
    }

    fn facts<T>(&self, read: impl FnOnce(&Facts) -> T) -> T {
        read(&self.facts.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Drop for Core {
    fn drop(&mut self) {
        let none = Arc::new(tokio::sync::Mutex::new(None));
        let mut endpoint = Some(std::mem::replace(&mut self.endpoint, none));
        if self.owner.is_parent() {
            // The end of a copy would close the connection of the parent.
            std::mem::forget(endpoint);
            return;
        }
        // Without the GIL: its guards may wait for a safe function, which waits for the GIL.
        let _ = Python::try_attach(|py| py.detach(|| drop(endpoint.take())));
    }
}

#[pymethods]
impl Core {
    #[getter]
    fn tid(&self) -> u64 {
        self.facts(|facts| facts.tid)
    }

    #[getter]
    fn registrations(&self) -> u64 {
        self.facts(|facts| facts.registrations)
    }

    #[getter]
    fn node_name(&self) -> String {
        self.facts(|facts| facts.node_name.clone())
    }

    #[getter]
    fn payload_max(&self) -> usize {
        self.facts(|facts| facts.payload_max)
    }

    #[getter]
    fn is_ring(&self) -> bool {
        self.facts(|facts| facts.is_ring)
    }

    /// Sends without a confirmation.
    fn send(&self, py: Python<'_>, message: Outgoing) -> PyResult<Operation> {
        let draft = message.check()?;
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                draft.builder(endpoint).await?.send().await?;
                Ok(Done::Nothing)
            })
        })
    }

    /// Sends, and waits for the outcome: its code.
    fn send_confirmed(&self, py: Python<'_>, message: Outgoing, within: f64) -> PyResult<Operation> {
        let (draft, within) = (message.check()?, seconds("within", within)?);
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                let outcome = draft.builder(endpoint).await?.confirmed(within).await?;
                Ok(Done::Outcome(outcome))
            })
        })
    }

    /// Sends to many, and waits for the outcome of each: pairs of the bits of a TID and a code.
    fn send_confirmed_by_each(&self, py: Python<'_>, message: Outgoing, within: f64) -> PyResult<Operation> {
        let (draft, within) = (message.check()?, seconds("within", within)?);
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                let outcomes = draft.builder(endpoint).await?.confirmed_by_each(within).await?;
                Ok(Done::Members(outcomes))
            })
        })
    }

    /// Sends a request, and waits for the reply: a `Received`.
    fn ask(&self, py: Python<'_>, message: Outgoing, within: f64) -> PyResult<Operation> {
        let (draft, within) = (message.check()?, seconds("within", within)?);
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                let reply = draft.builder(endpoint).await?.ask_raw(within).await?;
                Ok(Done::Received(Arc::new(reply)))
            })
        })
    }

    /// Answers a request. The destination of the message is not used.
    fn reply(&self, py: Python<'_>, request: &Received, message: Outgoing) -> PyResult<Operation> {
        let draft = message.check()?;
        let Some(request) = request.request() else {
            let text =
                "the request is settled already, so nothing waits for a reply; reply before it is settled";
            return Err(errors::named(py, "NotAskedError", text));
        };
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                let to = request.source();
                draft.builder_to(endpoint, to)?.reply_to(&request).await?;
                Ok(Done::Nothing)
            })
        })
    }

    /// Waits for a message: a `Received`.
    fn receive(&self, py: Python<'_>) -> PyResult<Operation> {
        self.begin_with_parameters(py, |registered| {
            Box::pin(async move { Ok(Done::Received(Arc::new(registered.receive().await?))) })
        })
    }

    /// Sends without a confirmation, and blocks until the message has room.
    fn send_now(&self, py: Python<'_>, message: Outgoing) -> PyResult<()> {
        self.send(py, message)?.run(py, None).map(drop)
    }

    /// Blocks until a message arrives, `timeout` seconds at most: a `Received`, or `None`.
    #[pyo3(signature = (timeout=None))]
    fn receive_now(&self, py: Python<'_>, timeout: Option<f64>) -> PyResult<Option<Py<PyAny>>> {
        Ok(self.receive(py)?.run(py, timeout)?.map(|(received,)| received))
    }

    /// Begins a turn of the loop that reads the parameters.
    fn tick(&self, py: Python<'_>) -> PyResult<Operation> {
        self.begin_with_parameters(py, |registered| {
            Box::pin(async move {
                registered.tick().await;
                Ok(Done::Nothing)
            })
        })
    }

    /// Looks a name up: the bits of a TID, or `None`.
    fn resolve(&self, py: Python<'_>, name: String, within: f64) -> PyResult<Operation> {
        let within = seconds("within", within)?;
        self.begin(py, move |endpoint| {
            Box::pin(async move { Ok(Done::Resolved(endpoint.resolve(&name, within).await?)) })
        })
    }

    /// Reports that the program is ready to the node that has started it.
    fn ready(&self, py: Python<'_>) -> PyResult<Operation> {
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                endpoint.ready().await?;
                Ok(Done::Nothing)
            })
        })
    }

    /// Joins a group, or leaves it.
    fn set_member(&self, py: Python<'_>, group: String, is_member: bool) -> PyResult<Operation> {
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                match is_member {
                    true => endpoint.join(&group).await?,
                    false => endpoint.leave(&group).await?,
                }
                Ok(Done::Nothing)
            })
        })
    }

    /// Waits at a barrier: the number of its opening. `options`: whether it fails when a party is lost, and whether it
    /// is a phase.
    #[expect(clippy::too_many_arguments, reason = "Python calls it, and `py` is none of its arguments")]
    fn meet(
        &self,
        py: Python<'_>,
        name: &str,
        parties: Vec<String>,
        within: f64,
        options: (bool, bool),
    ) -> PyResult<Operation> {
        let (fails_on_loss, is_phase) = options;
        let barrier = if is_phase { Barrier::phase(name, parties) } else { Barrier::new(name, parties) };
        let on_loss = if fails_on_loss { OnPartyLoss::Fail } else { OnPartyLoss::Wait };
        let barrier = barrier.within(seconds("within", within)?).on_loss(on_loss);
        self.begin(py, move |endpoint| {
            Box::pin(
                async move { endpoint.meet(&barrier).await.map(Done::Generation).map_err(Failure::Barrier) },
            )
        })
    }

    /// Sets parameters of several applications as one transaction: the verdict, and the outcome of each.
    fn set_together(
        &self,
        py: Python<'_>,
        sets: Vec<(String, Vec<(String, AnyValue)>)>,
        lead: f64,
        within: f64,
    ) -> PyResult<Operation> {
        let (lead, within) = (seconds("lead", lead)?, seconds("within", within)?);
        let named = |(name, value): (String, AnyValue)| NamedValue { name, value: value.into() };
        let sets = sets.into_iter().map(|(app, values)| (app, values.into_iter().map(named).collect()));
        let sets = sets.collect();
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                endpoint.set_together(sets, lead, within).await.map(Done::Together).map_err(Failure::Together)
            })
        })
    }

    /// Sends a protected payload.
    fn send_protected(
        &self,
        py: Python<'_>,
        to: To,
        payload_type: ProtectedType,
        payload: PyBackedBytes,
    ) -> PyResult<Operation> {
        let (protected, class) = payload_type.read()?;
        self.begin(py, move |endpoint| {
            Box::pin(async move {
                let to = to.find(endpoint, NAMED_WITHIN).await?;
                endpoint.send_sealed(to, (&protected, class), &payload).await?;
                Ok(Done::Nothing)
            })
        })
    }

    /// Guards the messages of a protected type from `source`. `safe` is called with the cause, on another thread.
    fn guard(
        &self,
        py: Python<'_>,
        source: u64,
        payload_type: ProtectedType,
        safe: Py<PyAny>,
    ) -> PyResult<OutputGuard> {
        let (protected, _) = payload_type.read()?;
        check_may_guard(py)?;
        let mut lease = self.lease(py)?;
        let output = ((), safe_function(safe));
        let made = py.detach(move || {
            lease.as_mut().map(|of| of.endpoint.hold(Tid::from_bits(source), protected, output))
        });
        match made {
            Some(made) => made.map(OutputGuard::new).map_err(|error| errors::guard(py, &error)),
            None => Err(gone(py)),
        }
    }

    /// Returns the next report of messages that were not delivered. Never waits.
    fn take_undelivered(&self, py: Python<'_>) -> PyResult<Option<UndeliveredTuple>> {
        let mut lease = self.lease(py)?;
        let report = lease.as_mut().and_then(|of| of.endpoint.take_undelivered());
        Ok(report.map(|report| {
            let code = Outcome::Rejected(report.why).code();
            (report.destination.bits(), report.name, report.kind.map(Kind::bits), code, report.count)
        }))
    }

    /// Releases the address, and waits for the node's confirmation.
    fn unregister(&self, py: Python<'_>) -> PyResult<Operation> {
        let mut lease = self.lease(py)?;
        let future = async move {
            match lease.take() {
                Some(of) => of.endpoint.unregister().await.map(|()| Done::Nothing).map_err(Failure::Api),
                None => Err(Failure::Gone),
            }
        };
        Ok(Operation::new(Box::pin(future), self.events.clone()))
    }

    /// Releases the address at once. Has no effect on one that is released, and on a copy in the child of a fork.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        if !self.owner.is_parent() {
            let endpoint = Arc::clone(&self.endpoint).try_lock_owned();
            let mut endpoint = endpoint.map_err(|_| busy(py))?;
            py.detach(move || drop(endpoint.take()));
        }
        Ok(())
    }
}
