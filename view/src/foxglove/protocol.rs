//! The messages of the protocol `foxglove.websocket.v1`, which is also that of `foxglove.sdk.v1` as far as it is used
//! here. Clients send JSON; the server sends JSON, and views of messages as bytes.

use std::collections::BTreeMap;

use hyper::body::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::source::LiveChannel;

/// The protocols of this server, as clients name them.
pub(super) const PROTOCOLS: [&str; 2] = ["foxglove.websocket.v1", "foxglove.sdk.v1"];
/// The first byte of a message with a view.
const MESSAGE_DATA: u8 = 1;

/// A message of a client.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(super) enum ClientMessage {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    /// Without names: all.
    GetParameters {
        parameter_names: Vec<String>,
        id: Option<String>,
    },
    SetParameters {
        parameters: Vec<GivenParameter>,
        id: Option<String>,
    },
    /// Without names: all.
    SubscribeParameterUpdates {
        parameter_names: Vec<String>,
    },
    /// Without names: all.
    UnsubscribeParameterUpdates {
        parameter_names: Vec<String>,
    },
    /// A message for which the server has not declared the capability.
    #[serde(other)]
    Other,
}

/// A subscription to a channel. The client chooses its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Subscription {
    pub(super) id: u32,
    pub(super) channel_id: u32,
}

/// A parameter with the value that the client wants.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(super) struct GivenParameter {
    pub(super) name: String,
    #[serde(default)]
    pub(super) value: Value,
}

impl ClientMessage {
    /// Reads a message. Its length is bounded by the connection.
    ///
    /// # Errors
    /// Why it is none.
    pub(super) fn read(text: &str) -> Result<Self, String> {
        serde_json::from_str(text).map_err(|why| format!("this is no message of {}: {why}", PROTOCOLS[0]))
    }
}

/// The level of a status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Level {
    Warning = 1,
    Error = 2,
}

fn text(value: &Value) -> Message {
    Message::text(value.to_string())
}

/// The first message of a connection. `session` is another one for each start of the server.
pub(super) fn server_info(session: &str) -> Message {
    text(&json!({
        "op": "serverInfo", "name": "sinew view", "capabilities": ["parameters", "parametersSubscribe"],
        "sessionId": session, "metadata": { "sinew-version": env!("CARGO_PKG_VERSION") },
    }))
}

/// Announces channels.
pub(super) fn advertise<'c>(channels: impl IntoIterator<Item = (u32, &'c LiveChannel)>) -> Message {
    let channels = channels.into_iter().map(|(id, channel)| {
        let LiveChannel { topic, encoding, schema_name, schema_encoding, schema, metadata } = channel;
        json!({
            "id": id, "topic": topic, "encoding": encoding, "schemaName": schema_name,
            "schemaEncoding": schema_encoding, "schema": schema_text(schema_encoding, schema), "metadata": metadata,
        })
    });
    text(&json!({ "op": "advertise", "channels": channels.collect::<Vec<_>>() }))
}

/// Returns a schema as a text: a schema of protocol buffers in base64, as the protocol has it.
fn schema_text(encoding: &str, schema: &[u8]) -> String {
    use base64::prelude::{BASE64_STANDARD, Engine as _};
    if encoding == "protobuf" {
        BASE64_STANDARD.encode(schema)
    } else {
        String::from_utf8_lossy(schema).into_owned()
    }
}

/// Withdraws a channel, and all subscriptions to it.
pub(super) fn unadvertise(id: u32) -> Message {
    text(&json!({ "op": "unadvertise", "channelIds": [id] }))
}

/// A view of a message, for a subscription. `time_ns` is of the wall clock.
pub(super) fn message_data(subscription: u32, time_ns: u64, data: &[u8]) -> Message {
    let mut bytes = Vec::with_capacity(13 + data.len());
    bytes.push(MESSAGE_DATA);
    bytes.extend(subscription.to_le_bytes());
    bytes.extend(time_ns.to_le_bytes());
    bytes.extend_from_slice(data);
    Message::Binary(Bytes::from(bytes))
}

/// A text for the user. One with an ID replaces the former one of this ID.
pub(super) fn status(level: Level, message: &str, id: Option<&str>) -> Message {
    let mut all = json!({ "op": "status", "level": level as u8, "message": message });
    if let Some(id) = id {
        all["id"] = id.into();
    }
    text(&all)
}

/// Withdraws texts for the user.
pub(super) fn remove_status(ids: &[String]) -> Message {
    text(&json!({ "op": "removeStatus", "statusIds": ids }))
}

/// Values of parameters, as an answer to the request with this ID, or as an update.
pub(super) fn parameter_values(values: &BTreeMap<String, Value>, id: Option<&str>) -> Message {
    let values = values.iter().map(|(name, value)| {
        let mut one = json!({ "name": name, "value": value });
        // A float without a fraction is not a whole number.
        if value.is_f64() {
            one["type"] = "float64".into();
        }
        one
    });
    let mut all = json!({ "op": "parameterValues", "parameters": values.collect::<Vec<_>>() });
    if let Some(id) = id {
        all["id"] = id.into();
    }
    text(&all)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn json_of(message: &Message) -> Value {
        serde_json::from_str(message.to_text().expect("it is text")).expect("it is JSON")
    }

    #[test]
    fn messages_of_the_official_client_are_read() {
        let read = |text: &str| ClientMessage::read(text).expect("it is legal");
        assert_eq!(
            read(r#"{"op":"subscribe","subscriptions":[{"id":3,"channelId":7}]}"#),
            ClientMessage::Subscribe { subscriptions: vec![Subscription { id: 3, channel_id: 7 }] }
        );
        assert_eq!(
            read(r#"{"op":"unsubscribe","subscriptionIds":[3]}"#),
            ClientMessage::Unsubscribe { subscription_ids: vec![3] }
        );
        assert_eq!(
            read(r#"{"op":"getParameters","parameterNames":[]}"#),
            ClientMessage::GetParameters { parameter_names: Vec::new(), id: None }
        );
        let given = GivenParameter { name: "knee.gain".to_owned(), value: json!(0.5) };
        assert_eq!(
            read(
                r#"{"op":"setParameters","id":"a","parameters":[{"name":"knee.gain","value":0.5,"type":"float64"}]}"#
            ),
            ClientMessage::SetParameters { parameters: vec![given], id: Some("a".to_owned()) }
        );
        assert_eq!(read(r#"{"op":"fetchAsset","uri":"package://x","requestId":1}"#), ClientMessage::Other);
        for wrong in
            ["", "[]", "{}", r#"{"op":"subscribe"}"#, r#"{"op":"unsubscribe","subscriptionIds":[-1]}"#]
        {
            assert!(ClientMessage::read(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn channels_have_the_schema_as_text() {
        let of = |encoding: &str, schema: &[u8]| LiveChannel {
            topic: "/knee/exo.angle/view".to_owned(),
            encoding: encoding.to_owned(),
            schema_encoding: encoding.to_owned(),
            schema: schema.to_vec(),
            ..LiveChannel::default()
        };
        let (typed, plain) = (of("protobuf", &[0xff, 0]), of("jsonschema", b"{}"));
        let found = json_of(&advertise([(1, &typed), (2, &plain)]));
        let schemas: Vec<_> =
            found["channels"].as_array().into_iter().flatten().map(|one| one["schema"].clone()).collect();
        assert_eq!(schemas, [json!("/wA="), json!("{}")]);
        assert_eq!(json_of(&unadvertise(2)), json!({ "op": "unadvertise", "channelIds": [2] }));
    }

    #[test]
    fn view_has_its_subscription_and_time_in_front() {
        let Message::Binary(bytes) = message_data(0x0102, 3, b"view") else { panic!("it is binary") };
        assert_eq!(&bytes[..], b"\x01\x02\x01\0\0\x03\0\0\0\0\0\0\0view");
    }

    #[test]
    fn float_without_a_fraction_keeps_its_type() {
        let values = BTreeMap::from([("a".to_owned(), json!(1.0)), ("b".to_owned(), json!(1))]);
        let found = json_of(&parameter_values(&values, Some("7")));
        assert_eq!((&found["parameters"][0]["type"], &found["id"]), (&json!("float64"), &json!("7")));
        assert!(found["parameters"][1]["type"].is_null() && found["parameters"][1]["value"] == json!(1));
        let found = json_of(&status(Level::Warning, "slow", Some("dropped")));
        assert_eq!((&found["level"], &found["id"]), (&json!(1), &json!("dropped")));
    }

    proptest! {
        #[test]
        fn any_text_is_read_or_refused(text in ".{0,200}") {
            let _ = ClientMessage::read(&text);
        }
    }
}
