//! Requests of ROS 2, and their replies.

use std::sync::mpsc::{SyncSender, TrySendError};

use sinew_ros2_core::{Attachment, Cause, EndpointKind, GraphNode, Refusal, Service, Value, decode, encode};
use tracing::{debug, info};
use zenoh::{
    Wait as _,
    bytes::Encoding,
    query::{Query, Queryable},
};

use crate::{clock, counts::Counts, graph::Graph};

/// A request that waits for its reply.
pub(crate) struct Request<T> {
    query: Query,
    /// The service, as requests name it.
    pub(crate) topic: String,
    /// The act of the service.
    pub(crate) of: T,
    /// The request.
    pub(crate) value: Value,
    attachment: Attachment,
    service: Service,
}

/// The requests of a thread: its queue, and the counts.
#[derive(Clone)]
pub(crate) struct Requests<T> {
    pub(crate) queue: SyncSender<Request<T>>,
    pub(crate) counts: Counts,
}

impl<T> Request<T> {
    /// Replies with a response of the service.
    pub(crate) fn reply(self, response: &Value, counts: &Counts) {
        let bytes = match encode(&self.service.response, response) {
            Ok(bytes) => bytes,
            Err(why) => return self.fail(&format!("the response does not fit its type: {why}"), counts),
        };
        // The number and the identity are those of the request: by them the client finds its call.
        let attachment = Attachment { time_ns: clock::wall_ns(), ..self.attachment }.encode();
        let reply = self.query.reply(self.query.key_expr().clone(), bytes);
        let reply = reply.encoding(Encoding::APPLICATION_CDR).attachment(&attachment[..]);
        match reply.wait() {
            Ok(()) => counts.pass(&self.topic),
            // The client is gone.
            Err(why) => debug!("{}: the reply was not sent: {why}", self.topic),
        }
    }

    /// Replies that nothing was done.
    pub(crate) fn fail(self, why: &str, counts: &Counts) {
        counts.refuse(&self.topic, &Refusal::new(Cause::NotSent, why), 1);
        let _ = self.query.reply_err(why).wait();
    }
}

/// Serves a service: hands its requests to a thread, and refuses those that are malformed or too many.
///
/// # Errors
/// The session is closed.
pub(crate) fn serve<T: Clone + Send + Sync + 'static>(
    (graph, node): (&Graph, &GraphNode),
    (topic, service): (&str, &Service),
    of: T,
    requests: Requests<T>,
) -> Result<Queryable<()>, String> {
    let (name, described) = (&service.name, &*service.description);
    let declared = graph.endpoint(node, EndpointKind::Service, topic, (name, described))?;
    info!("serves {topic}: {}", declared.key);
    let (topic, service) = (topic.to_owned(), service.clone());
    let take = move |query: Query| {
        let request = match read(&query, &service) {
            Ok((value, attachment)) => {
                let (topic, of, service) = (topic.clone(), of.clone(), service.clone());
                Request { query, topic, of, value, attachment, service }
            }
            Err(why) => {
                let refusal = Refusal::new(Cause::Malformed, why);
                requests.counts.refuse(&topic, &refusal, 1);
                let _ = query.reply_err(refusal.to_string()).wait();
                return;
            }
        };
        if let Err(TrySendError::Full(request) | TrySendError::Disconnected(request)) =
            requests.queue.try_send(request)
        {
            let refusal = Refusal::new(Cause::QueueFull, "too many requests wait; send fewer at once");
            requests.counts.refuse(&topic, &refusal, 1);
            let _ = request.query.reply_err(refusal.to_string()).wait();
        }
    };
    // Clients ask only servers that are complete.
    let declared = graph.session.declare_queryable(declared.key).complete(true).callback(take).wait();
    declared.map_err(|why| format!("zenoh: {why}"))
}

fn read(query: &Query, service: &Service) -> Result<(Value, Attachment), String> {
    let attachment = query.attachment().ok_or("a request has an attachment, as rmw_zenoh sends it")?;
    let attachment = Attachment::parse(&attachment.to_bytes()).map_err(|why| why.to_string())?;
    let payload = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
    let value = decode(&service.request, &payload).map_err(|why| why.to_string())?;
    Ok((value, attachment))
}
