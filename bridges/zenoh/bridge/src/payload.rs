//! Payloads on their way between Sinew and Zenoh.

use sinew::{protection::unsealed, schema::Schema};

use crate::{
    Encoding, MalformedError, Refusal, Value,
    typed::{Form, fitted},
};

/// A payload of Zenoh that is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PayloadError {
    /// It is no payload of its type.
    Malformed(MalformedError),
    /// It is the envelope of a protected command.
    Envelope,
}

impl PayloadError {
    /// Returns the cause for the counters.
    #[must_use]
    pub const fn refusal(&self) -> Refusal {
        match self {
            Self::Malformed(_) => Refusal::Malformed,
            Self::Envelope => Refusal::Envelope,
        }
    }
}

/// Returns the payload for an application of Sinew. If the structure of the type is known, the payload has exactly
/// that structure, and its receiver reads it. Otherwise it is one value of MessagePack.
///
/// # Errors
/// The payload is refused.
///
/// # Examples
///
/// ```
/// use sinew_zenoh_rules::{Encoding, payload::{inward, outward}};
///
/// let payload = inward(br#"{"degrees":12.5}"#, Encoding::Json, None).expect("it is JSON");
/// assert_eq!(outward(&payload, Encoding::Json).as_deref(), Ok(&br#"{"degrees":12.5}"#[..]));
/// assert!(inward(b"{degrees}", Encoding::Json, None).is_err());
/// ```
pub fn inward(bytes: &[u8], encoding: Encoding, schema: Option<&Schema>) -> Result<Vec<u8>, PayloadError> {
    // Only raw bytes can be an envelope: it is no value of MessagePack.
    let (value, form) = match encoding {
        Encoding::Raw if unsealed(bytes).is_some() => return Err(PayloadError::Envelope),
        Encoding::Raw => return Ok(bytes.to_vec()),
        // A type without fields may be sent without bytes.
        _ if bytes.is_empty() => (Ok(Value::Nil), Form::MessagePack),
        Encoding::MessagePack => (Value::read(bytes), Form::MessagePack),
        Encoding::Json => (Value::read_json(bytes), Form::Json),
    };
    let fit = |value: Value| match schema {
        Some(schema) => fitted(value, schema, form),
        None => Ok(value),
    };
    let value = value.and_then(fit).map_err(PayloadError::Malformed)?;
    Ok(if value == Value::Nil && bytes.is_empty() { Vec::new() } else { value.written() })
}

/// Returns the payload for a Zenoh program: that of a protected command without its envelope.
///
/// # Errors
/// It is no value of MessagePack.
pub fn outward(bytes: &[u8], encoding: Encoding) -> Result<Vec<u8>, MalformedError> {
    let bytes = unsealed(bytes).map_or(bytes, |unsealed| unsealed.payload);
    match encoding {
        Encoding::Raw => Ok(bytes.to_vec()),
        Encoding::Json if bytes.is_empty() => Ok(b"null".to_vec()),
        Encoding::MessagePack if bytes.is_empty() => Ok(Vec::new()),
        Encoding::MessagePack => Value::read(bytes).map(|_| bytes.to_vec()),
        Encoding::Json => Value::read(bytes).map(|value| value.json().into_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew::{
        Tid, Time,
        protection::{DataId, Stamp, seal},
    };

    use super::*;
    use crate::value::tests::values;

    fn sealed(payload: &[u8]) -> Vec<u8> {
        let data_id =
            DataId { source: Tid::from_bits(1), destination: Tid::from_bits(2), name: "leg.torque" };
        let stamp = Stamp { counter: 3, incarnation: 7, echo: Time::ZERO };
        seal(&data_id, stamp, payload).to_vec()
    }

    #[test]
    fn forged_envelope_does_not_pass() {
        let forged = sealed(&Value::F64(1.0).written());
        assert_eq!(inward(&forged, Encoding::Raw, None), Err(PayloadError::Envelope));
        let why = inward(&forged, Encoding::MessagePack, None).expect_err("it is no value");
        assert_eq!(why.refusal(), Refusal::Malformed);
    }

    #[test]
    fn protected_command_is_shown_without_its_envelope() {
        assert_eq!(outward(&sealed(&Value::F64(1.5).written()), Encoding::Json), Ok(b"1.5".to_vec()));
    }

    #[test]
    fn value_without_fields_may_have_no_bytes() {
        for encoding in [Encoding::MessagePack, Encoding::Json] {
            assert_eq!(inward(b"", encoding, None), Ok(Vec::new()));
        }
        assert_eq!(outward(b"", Encoding::Json), Ok(b"null".to_vec()));
    }

    proptest! {
        #[test]
        fn no_bytes_of_zenoh_become_an_envelope(bytes in proptest::collection::vec(any::<u8>(), 0..120)) {
            for encoding in [Encoding::MessagePack, Encoding::Json, Encoding::Raw] {
                for bytes in [&bytes, &sealed(&bytes)] {
                    if let Ok(payload) = inward(bytes, encoding, None) {
                        prop_assert!(unsealed(&payload).is_none());
                    }
                }
            }
        }

        #[test]
        fn values_pass_both_ways_unchanged(value in values()) {
            let written = value.written();
            let out = outward(&written, Encoding::MessagePack).expect("it is a value");
            prop_assert_eq!(&inward(&out, Encoding::MessagePack, None).expect("it is a value"), &written);
        }
    }
}
