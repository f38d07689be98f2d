//! One topic from Sinew to ROS: messages of one or several applications in one message of ROS.

use std::{sync::Arc, time::Duration};

use crate::{
    catalog::Structure,
    cdr::{CdrError, encode},
    convert::{ConvertError, to_ros},
    pace::Pace,
    path::{Expression, Path, Target},
    payload::Payload,
    value::Value,
};

const SECOND_NS: i64 = 1_000_000_000;

/// A topic that the bridge publishes.
#[derive(Clone, Debug)]
pub struct Outgoing {
    /// The topic.
    pub topic: String,
    /// The type.
    pub message: Arc<Structure>,
    /// The messages from which it is made.
    pub inputs: Vec<Input>,
    /// Maximum age of each input.
    max_age: Duration,
    pace: Pace,
    /// Seconds and nanoseconds of the stamp, if the type has one.
    stamp: Option<(Target, Target)>,
    /// Whether a message has arrived since the last one was published.
    has_news: bool,
    value: Value,
}

/// One of the messages from which a topic is made.
#[derive(Clone, Debug)]
pub struct Input {
    /// The name of its sender.
    pub app: String,
    /// The name of its type.
    pub type_name: String,
    fields: Vec<(Target, Expression)>,
    /// When the last good one was sent, on the host's monotonic clock.
    at: Option<Duration>,
}

impl Input {
    pub(crate) const fn new(app: String, type_name: String, fields: Vec<(Target, Expression)>) -> Self {
        Self { app, type_name, fields, at: None }
    }
}

impl Outgoing {
    pub(crate) fn new(
        topic: String,
        message: Arc<Structure>,
        inputs: Vec<Input>,
        (period, max_age): (Duration, Duration),
        constants: Vec<(Target, Value)>,
    ) -> Self {
        let mut value = Value::zero(&message);
        constants.into_iter().for_each(|(target, constant)| target.set(&mut value, constant));
        let part = |path: &str| Path::parse(path).ok().and_then(|path| Target::locate(&message, &path).ok());
        let stamp = ["header.stamp", "stamp"]
            .iter()
            .find_map(|path| part(&format!("{path}.sec")).zip(part(&format!("{path}.nanosec"))));
        Self { topic, message, inputs, max_age, pace: Pace::new(period), stamp, has_news: false, value }
    }

    /// Takes a message of an input, by its place in [`inputs`](Self::inputs). `at` is when it was sent, on the host's
    /// monotonic clock.
    ///
    /// # Errors
    /// A field is absent or does not fit: then nothing of the message is taken.
    pub fn take(&mut self, input: usize, payload: &[u8], at: Duration) -> Result<(), ConvertError> {
        let Some(input) = self.inputs.get_mut(input) else { return Ok(()) };
        let payload = Payload::read(payload).map_err(|why| ConvertError::new(why.to_string()))?;
        let mut values = Vec::with_capacity(input.fields.len());
        for (target, expression) in &input.fields {
            let path = &expression.path;
            let absent = || ConvertError::new(format!("{path}: {} has no such field", input.type_name));
            let found = path.find(&payload).ok_or_else(absent)?;
            values.push(to_ros(target, found, expression).map_err(|why| ConvertError::at(path, &why))?);
        }
        for ((target, _), value) in input.fields.iter().zip(values) {
            target.set(&mut self.value, value);
        }
        input.at = Some(at);
        self.has_news = true;
        Ok(())
    }

    /// Returns the bytes to publish, if there is news, all inputs are fresh and the rate allows it. `wall_ns` is the
    /// wall clock at `now`; the stamp is the time of the newest input.
    ///
    /// # Errors
    /// The message is too long.
    pub fn poll(&mut self, now: Duration, wall_ns: i64) -> Result<Option<Vec<u8>>, CdrError> {
        let is_fresh = |input: &Input| input.at.is_some_and(|at| now.saturating_sub(at) <= self.max_age);
        if !self.has_news || !self.inputs.iter().all(is_fresh) || !self.pace.take(now) {
            return Ok(None);
        }
        self.has_news = false;
        let newest = self.inputs.iter().filter_map(|input| input.at).max().unwrap_or(now);
        let age = i64::try_from(now.saturating_sub(newest).as_nanos()).unwrap_or(i64::MAX);
        let stamp_ns = wall_ns.saturating_sub(age);
        if let Some((seconds, nanoseconds)) = &self.stamp {
            let rest = stamp_ns.rem_euclid(SECOND_NS).unsigned_abs();
            // The seconds of ROS have 32 bits.
            let whole = stamp_ns.div_euclid(SECOND_NS).clamp(i32::MIN.into(), i32::MAX.into());
            seconds.set(&mut self.value, Value::Signed(whole));
            nanoseconds.set(&mut self.value, Value::Unsigned(rest));
        }
        encode(&self.message, &self.value).map(Some)
    }
}
