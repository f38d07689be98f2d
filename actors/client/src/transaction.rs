//! Setting parameters of several applications as one transaction.

use std::time::Duration;

use sinew_runtime::{
    clock::Clock,
    parameters::{Coordinator, NamedValue, Participant, Step, TransactionError, TransactionReport},
    tid::Tid,
    time::Time,
};

use super::{ApiError, AsyncEndpoint, Endpoint, wait_mode::WaitMode};

/// How long the node may take to resolve a name.
const RESOLVED_WITHIN: Duration = Duration::from_secs(1);

/// The reason why a transaction did not begin. Nothing was set.
#[derive(Debug, thiserror::Error)]
pub enum SetTogetherError {
    /// A name is unknown, there are too many applications, or the lead is outside of its range. The caller is at fault.
    #[error(transparent)]
    Transaction(#[from] TransactionError),
    /// The node did not resolve a name.
    #[error(transparent)]
    Api(#[from] ApiError),
}

const fn since_origin(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}

/// Returns the participant of this name, or the error that there is none.
fn participant(app: String, tid: Option<Tid>) -> Result<Participant, TransactionError> {
    let tid = tid.ok_or_else(|| TransactionError::UnknownName(app.clone()))?.bits();
    Ok(Participant { tid, app })
}

/// Returns the name of the participant with this index.
fn name(transaction: &Coordinator, index: usize) -> &str {
    transaction.participant(index).map_or("", |one| one.app.as_str())
}

impl Endpoint {
    /// Sets parameters of several applications, on any nodes, as one transaction: all apply their values at their first
    /// tick at or after one stated time, `lead` from now, or none does. The usual lead is
    /// [`LEAD`](sinew_runtime::parameters::LEAD), 250 ms. `sets` has the name of each application and its values.
    ///
    /// Returns when each application has reported, and at the latest `within` after the stated time. See
    /// [`Sender::set_together`](sinew_runtime::sender::Sender::set_together). Messages that arrive meanwhile wait.
    ///
    /// # Errors
    /// The transaction did not begin.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{
    ///     NodeApi, Registration,
    ///     parameters::{LEAD, NamedValue, Value},
    /// };
    ///
    /// let node = NodeApi::connect("/run/sinew/knee.sock")?;
    /// let mut tuner = node.register_transport_address(Registration::new().name("tuner"))?;
    /// let gain = || vec![NamedValue { name: "assistance".to_owned(), value: Value::Number(0.2) }];
    /// let sets = vec![("knee.drive".to_owned(), gain()), ("hip.drive".to_owned(), gain())];
    /// let report = tuner.set_together(sets, LEAD, Duration::from_secs(2))?;
    /// println!("{:?}", report.verdict);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn set_together(
        &mut self,
        sets: Vec<(String, Vec<NamedValue>)>,
        lead: Duration,
        within: Duration,
    ) -> Result<TransactionReport, SetTogetherError> {
        let mut named = Vec::new();
        for (app, values) in sets {
            let tid = self.resolve(&app, RESOLVED_WITHIN)?.map(|tid| self.absolute(tid));
            named.push((participant(app, tid)?, values));
        }
        let began = since_origin(Time::now());
        let mut transaction = Coordinator::begin(self.tid().bits(), named, (lead, within), began)?;
        loop {
            match transaction.next(since_origin(Time::now())) {
                Step::Ask { index, set, within } => {
                    let reply = self.message(name(&transaction, index), &set).ask(within);
                    transaction.answered(reply.map_err(|error| error.to_string()));
                }
                Step::Wait(until) => std::thread::sleep(until.saturating_sub(since_origin(Time::now()))),
                Step::Done => return Ok(transaction.report()),
            }
        }
    }
}

impl AsyncEndpoint {
    /// Waits as the endpoint's other calls do, by tokio or by another event loop.
    async fn sleep_until(&mut self, deadline: Time) {
        let polled = match &self.endpoint.wait_mode {
            WaitMode::Polled(events) => Some(events.clone()),
            WaitMode::Async(_) | WaitMode::Blocking => None,
        };
        match polled {
            Some(events) => events.sleep_until(deadline).await,
            None => {
                Clock::WALL.sleep_until(deadline).await;
            }
        }
    }

    /// Sets parameters of several applications as one transaction, like [`Endpoint::set_together`].
    ///
    /// # Errors
    /// The errors of [`Endpoint::set_together`].
    pub async fn set_together(
        &mut self,
        sets: Vec<(String, Vec<NamedValue>)>,
        lead: Duration,
        within: Duration,
    ) -> Result<TransactionReport, SetTogetherError> {
        let mut named = Vec::new();
        for (app, values) in sets {
            let tid = self.resolve(&app, RESOLVED_WITHIN).await?.map(|tid| self.endpoint.absolute(tid));
            named.push((participant(app, tid)?, values));
        }
        let began = since_origin(Time::now());
        let mut transaction = Coordinator::begin(self.tid().bits(), named, (lead, within), began)?;
        loop {
            match transaction.next(since_origin(Time::now())) {
                Step::Ask { index, set, within } => {
                    let reply = self.message(name(&transaction, index), &set).ask(within).await;
                    transaction.answered(reply.map_err(|error| error.to_string()));
                }
                Step::Wait(until) => self.sleep_until(Time::ZERO + until).await,
                Step::Done => return Ok(transaction.report()),
            }
        }
    }
}
