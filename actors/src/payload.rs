//! Declares payload types without a second dependency.

/// Declares a type that travels between applications: `payload!("project.name" => struct ...)`.
///
/// The type can be serialized by serde, and is a [`Payload`](crate::Payload) of that name and of class
/// Control. A type without fields is `payload!("project.stop" => struct Stop)`; a semicolon after it, or
/// after a tuple struct, is optional. Two things may follow the name:
///
/// - A class, as in `payload!("exo.angle", Stream => struct ...)`. Periodic values (measurements, setpoints)
///   are of class Stream: of these only the newest waits, and a late one is replaced. Commands that must
///   arrive are Control; Bulk gives way to both.
/// - A time to live, as in `payload!("exo.angle", Stream, expires_after = 20 ms => struct ...)`: a message of
///   the type that is older expires where it waits, and does not reach its handler. It is a number and a
///   unit, `us`, `ms` or `s`, from 1 us to 4294 s, and becomes
///   [`Payload::TIME_TO_LIVE`](crate::Payload::TIME_TO_LIVE). A send may say another one (`expires_after` of
///   its builder).
///
/// The word `retained` comes last, as in `payload!("exo.mode", retained => struct ...)`: a member that joins a group
/// later gets the latest value of each sender ([`Payload::RETAINED`](crate::Payload::RETAINED)). Such a type is
/// Control or Bulk.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream, expires_after = 20 ms =>
///     /// How far a joint is bent.
///     #[derive(Debug)]
///     pub struct Angle {
///         /// In degrees.
///         pub degrees: f32,
///     }
/// );
/// assert_eq!(Angle::NAME, "demo.angle");
/// assert_eq!((Angle::CLASS, Angle::TIME_TO_LIVE), (Class::Stream, Some(Duration::from_millis(20))));
/// ```
///
/// An invalid unit does not compile:
///
/// ```compile_fail
/// sinew::payload!("demo.angle", Stream, expires_after = 20 millis => struct Angle { degrees: f32 });
/// ```
///
/// Nor does a time to live of zero, or one that is too long, at the declaration of the type, used or not:
///
/// ```compile_fail
/// sinew::payload!("demo.angle", Stream, expires_after = 0 ms => struct Angle { degrees: f32 });
/// ```
///
/// ```compile_fail
/// sinew::payload!("demo.angle", Stream, expires_after = 4295 s => struct Angle { degrees: f32 });
/// ```
///
/// Nor does a retained type of class Stream:
///
/// ```compile_fail
/// sinew::payload!("demo.angle", Stream, retained => struct Angle { degrees: f32 });
/// ```
///
/// Types without fields, and tuple structs, with a semicolon or without:
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.stop" => struct Stop);
/// payload!("demo.go", Control, expires_after = 1 s => #[derive(Debug)] pub struct Go;);
/// payload!("demo.degrees" => pub(crate) struct Degrees(f32));
/// payload!("demo.radians" => struct Radians(f32););
/// assert_eq!((Stop::NAME, Go::NAME, Degrees::NAME, Radians::NAME), ("demo.stop", "demo.go", "demo.degrees", "demo.radians"));
/// ```
#[macro_export]
macro_rules! payload {
    ($name:literal, retained => $($item:tt)+) => {
        $crate::payload!(@declare [$name Control; true] $($item)+);
    };
    ($name:literal, expires_after = $amount:literal $unit:ident, retained => $($item:tt)+) => {
        $crate::payload!(@declare [$name Control $amount $unit; true] $($item)+);
    };
    ($name:literal, $class:ident, retained => $($item:tt)+) => {
        $crate::payload!(@declare [$name $class; true] $($item)+);
    };
    ($name:literal, $class:ident, expires_after = $amount:literal $unit:ident, retained => $($item:tt)+) => {
        $crate::payload!(@declare [$name $class $amount $unit; true] $($item)+);
    };
    ($name:literal => $($item:tt)+) => {
        $crate::payload!(@declare [$name Control] $($item)+);
    };
    ($name:literal, expires_after = $amount:literal $unit:ident => $($item:tt)+) => {
        $crate::payload!(@declare [$name Control $amount $unit] $($item)+);
    };
    ($name:literal, $class:ident => $($item:tt)+) => {
        $crate::payload!(@declare [$name $class] $($item)+);
    };
    ($name:literal, $class:ident, expires_after = $amount:literal $unit:ident => $($item:tt)+) => {
        $crate::payload!(@declare [$name $class $amount $unit] $($item)+);
    };
    ($name:literal, $($class:ident,)? expires_after = $($wrong:tt)*) => {
        ::core::compile_error!("expires_after is a number, a space and a unit, and `=>` or `, retained =>` after it: `expires_after = 20 ms => struct ...`");
    };
    (@declare $head:tt $(#[$meta:meta])* $visible:vis struct $type:ident $(($($fields:tt)*))?) => {
        $crate::payload!(@declare $head $(#[$meta])* $visible struct $type $(($($fields)*))?;);
    };
    (@declare $head:tt $(#[$meta:meta])* $visible:vis struct $type:ident $($rest:tt)*) => {
        $crate::payload!(@item $(#[$meta])* $visible struct $type $($rest)*);
        $crate::payload!(@impl $head $type);
    };
    (@declare $head:tt $(#[$meta:meta])* $visible:vis enum $type:ident $($rest:tt)*) => {
        $crate::payload!(@item $(#[$meta])* $visible enum $type $($rest)*);
        $crate::payload!(@impl $head $type);
    };
    (@item $($item:tt)+) => {
        #[derive($crate::serde::Serialize, $crate::serde::Deserialize)]
        #[serde(crate = "::sinew::serde")]
        $($item)+
    };
    (@impl [$name:literal $class:ident $($amount:literal $unit:ident)? $(; $retained:literal)?] $type:ident) => {
        impl $crate::Payload for $type {
            const NAME: &'static str = $name;
            const CLASS: $crate::Class = $crate::Class::$class;
            $(const TIME_TO_LIVE: ::core::option::Option<::core::time::Duration> =
                ::core::option::Option::Some($crate::payload!(@time $amount $unit));)?
            $(const RETAINED: bool = $retained;)?
        }
        $(const _: () = ::core::assert!(
            !($retained && ::core::matches!(<$type as $crate::Payload>::CLASS, $crate::Class::Stream)),
            "a retained payload is of class Control or Bulk"
        );)?
        // Outside of the implementation, because its constants are evaluated only if they are used.
        const _: () = match <$type as $crate::Payload>::TIME_TO_LIVE {
            ::core::option::Option::Some(time) => ::core::assert!(
                time.as_micros() > 0 && time.as_micros() <= u32::MAX as u128,
                "expires_after is from 1 us to 4294 s"
            ),
            ::core::option::Option::None => {}
        };
    };
    (@time $amount:literal us) => { ::core::time::Duration::from_micros($amount) };
    (@time $amount:literal ms) => { ::core::time::Duration::from_millis($amount) };
    (@time $amount:literal s) => { ::core::time::Duration::from_secs($amount) };
    (@time $amount:literal $unit:ident) => {
        ::core::compile_error!(::core::concat!(
            "`", ::core::stringify!($unit), "` is no unit of expires_after; take us, ms or s, as in `expires_after = 20 ms`"
        ))
    };
}
