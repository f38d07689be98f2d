//! Setting parameters of several applications as one transaction.

use std::time::Duration;

use sinew_params::{
    Coordinator, NamedValue, ParameterOutcome, Participant, SetParameters, Step, TransactionError,
    TransactionReport,
};

use super::Sender;
use crate::time::Time;

impl Sender {
    /// Sets parameters of several applications, on any nodes, as one transaction: all apply their values at their first
    /// tick at or after one stated time, `lead` from now, or none does. The usual lead is
    /// [`LEAD`](crate::parameters::LEAD), 250 ms. `sets` has the name of each application and its values.
    ///
    /// The report names the tick and the time of each application. `within` is how long after the stated time this
    /// application waits for that, and repairs: it sets the values of an application that accepted and was restarted.
    /// The applications agree among themselves, so that the transaction is not lost with this application. The book's
    /// page "Tune a running loop" has the guarantee and its limits.
    ///
    /// # Errors
    /// The transaction did not begin: a name is unknown, there are too many applications, or the lead is too short or
    /// too long.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{
    ///     parameters::{LEAD, NamedValue, TransactionVerdict, Value},
    ///     prelude::*,
    /// };
    ///
    /// struct Therapist;
    /// # impl Actor for Therapist { type Context = AppContext<Self>; }
    ///
    /// fn assist_less(therapist: &Therapist, ctx: &mut AppContext<Therapist>) {
    ///     let gain = || vec![NamedValue { name: "assistance".to_owned(), value: Value::Number(0.2) }];
    ///     let sets = vec![("knee.drive".to_owned(), gain()), ("hip.drive".to_owned(), gain())];
    ///     let report = ctx.sender().set_together(sets, LEAD, Duration::from_secs(2));
    ///     ctx.spawn(report.into_actor(therapist).map(|report, _, _| match report {
    ///         Ok(report) if report.verdict == TransactionVerdict::All => println!("both assist less"),
    ///         Ok(report) => eprintln!("{:?}: {:?}", report.verdict, report.parts),
    ///         Err(error) => eprintln!("nothing was set: {error}"),
    ///     }));
    /// }
    /// ```
    pub fn set_together(
        &self,
        sets: Vec<(String, Vec<NamedValue>)>,
        lead: Duration,
        within: Duration,
    ) -> impl Future<Output = Result<TransactionReport, TransactionError>> + use<> {
        let sender = self.clone();
        async move {
            let mut named = Vec::new();
            for (app, values) in sets {
                let tid = sender.resolve(&app).ok_or_else(|| TransactionError::UnknownName(app.clone()))?;
                named.push((Participant { tid: sender.absolute(tid).bits(), app }, values));
            }
            let began = since_origin(sender.now());
            let mut transaction = Coordinator::begin(sender.tid().bits(), named, (lead, within), began)?;
            loop {
                match transaction.next(since_origin(sender.now())) {
                    Step::Ask { index, set, within } => {
                        let app = transaction.participant(index).map_or("", |one| one.app.as_str());
                        let reply = sender.ask_participant(app, &set, within).await;
                        transaction.answered(reply);
                    }
                    Step::Wait(until) => sender.clock().sleep_until(Time::ZERO + until).await,
                    Step::Done => return Ok(transaction.report()),
                }
            }
        }
    }

    /// Sends one request of a transaction. By the name, since an application that was restarted may have another TID.
    async fn ask_participant(
        &self,
        app: &str,
        set: &SetParameters,
        within: Duration,
    ) -> Result<ParameterOutcome, String> {
        let reply = self.message(app, set).ask(within).map_err(|error| error.to_string())?;
        reply.await.map_err(|error| error.to_string())
    }
}

const fn since_origin(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}
