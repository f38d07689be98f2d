//! Requests and confirmed messages into Sinew: queries of Zenoh. Each client has one at a time.

use std::sync::Arc;

use sinew::{
    Outcome,
    client::ApiError,
    message::{Class, MemberOutcome},
};
use sinew_bridge_node::{NodeClient, Outgoing};
use sinew_zenoh_rules::{Get, InRoute, Passed, Refusal, outcome, payload::outward};
use tokio::sync::{Mutex, mpsc::Receiver};
use tracing::debug;

use crate::{
    forward::ignore,
    inlet::Request,
    main_client::payload_for,
    shared::{Shared, destination},
    zenoh_sender::ZenohSender,
};

/// The queue of requests, which the clients share.
pub(crate) type Requests = Arc<Mutex<Receiver<Request>>>;

/// A refused query: the cause, the details for the log, and the outcome if there is one.
type Refused = (Refusal, String, Option<Outcome>);

/// Serves requests until the client ends.
pub(crate) async fn run(
    shared: Arc<Shared>,
    mut client: NodeClient,
    requests: Requests,
    zenoh_sender: ZenohSender,
) -> ApiError {
    loop {
        shared.note_own(client.tid());
        let next = async { requests.lock().await.recv().await };
        tokio::select! {
            seen = client.receive() => match seen {
                Ok(seen) => ignore(seen),
                Err(why @ ApiError::Disconnected(_)) => debug!("{why}"),
                Err(why) => return why,
            },
            Some(request) = next => answer(&shared, &mut client, request, &zenoh_sender).await,
        }
    }
}

async fn answer(shared: &Shared, client: &mut NodeClient, request: Request, zenoh_sender: &ZenohSender) {
    let route = &shared.config.rules.inward()[request.route];
    let result = match try_answer(shared, client, &request, route).await {
        Ok(reply) => Ok(reply),
        Err((why, detail, outcome)) => {
            let text = if detail.is_empty() { why.to_string() } else { detail.clone() };
            shared.refuse(why, &route.address.key(shared.config.rules.project()), &detail);
            Err(outcome::error(&text, outcome, route.encoding))
        }
    };
    if !zenoh_sender.reply(request.query, result, route.encoding) {
        shared.refuse(Refusal::QueueFullOut, "a reply", "");
    }
}

async fn try_answer(
    shared: &Shared,
    client: &mut NodeClient,
    request: &Request,
    route: &InRoute,
) -> Result<Vec<u8>, Refused> {
    let Some(within) = route.within.checked_sub(request.arrived.elapsed()) else {
        let detail = "the query has waited in the bridge; raise `requests` or `within_ms`".to_owned();
        return Err((Refusal::TooOld, detail, Some(Outcome::Expired)));
    };
    let payload = payload_for(shared, (request.route, route), &request.payload);
    let payload = payload.map_err(|(why, detail)| (why, detail, None))?;
    let to = destination(&route.address.target);
    let (get, kind) = (route.get.unwrap_or(Get::Ask), route.kind);
    let class = if get == Get::Ask { Class::Control } else { route.class };
    let message = Outgoing { to: &to, kind, class, payload: &payload, expires_after: route.expires_after };
    match get {
        Get::Ask => {
            let reply = client.ask(&message, within).await.map_err(refused)?;
            shared.pass(Passed::AskedIn);
            outward(reply.bytes(), route.encoding)
                .map_err(|why| (Refusal::MalformedOut, why.to_string(), None))
        }
        Get::Confirm => {
            let outcomes = client.confirm(&message, within).await.map_err(refused)?;
            shared.pass(Passed::ConfirmedIn);
            let is_rejected = |one: &&MemberOutcome| matches!(one.outcome, Outcome::Rejected(_));
            let rejected = outcomes.iter().filter(is_rejected).count() as u64;
            if rejected > 0 {
                let key = route.address.key(shared.config.rules.project());
                shared.refuse_several(Refusal::Rejected, rejected, &key, "");
            }
            Ok(outcome::reply(&outcomes, route.address.target.is_single(), route.encoding))
        }
    }
}

fn refused(why: ApiError) -> Refused {
    if let ApiError::Ended(outcome) = why {
        return (Refusal::Rejected, why.to_string(), Some(outcome));
    }
    if let ApiError::NoReply(_) = why {
        return (Refusal::Rejected, why.to_string(), Some(Outcome::Unknown));
    }
    (Refusal::NotSent, why.to_string(), None)
}
