//! Declares payload types without a second dependency.

/// Declares a type that travels between applications: `payload!("project.name" => struct ...)`.
///
/// The type can be written and read by serde, and is a [`Payload`](crate::Payload) of that name and of class Control.
/// A class after the name, as in `payload!("exo.angle", Stream => struct ...)`, makes it another.
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream =>
///     /// How far a joint is bent.
///     #[derive(Debug)]
///     pub struct Angle {
///         /// In degrees.
///         pub degrees: f32,
///     }
/// );
/// assert_eq!(Angle::NAME, "demo.angle");
/// ```
#[macro_export]
macro_rules! payload {
    ($name:literal => $($item:tt)+) => {
        $crate::payload!($name, Control => $($item)+);
    };
    ($name:literal, $class:ident => $(#[$meta:meta])* $visible:vis struct $type:ident $($rest:tt)*) => {
        $crate::payload!(@item $(#[$meta])* $visible struct $type $($rest)*);
        $crate::payload!(@impl $name, $class, $type);
    };
    ($name:literal, $class:ident => $(#[$meta:meta])* $visible:vis enum $type:ident $($rest:tt)*) => {
        $crate::payload!(@item $(#[$meta])* $visible enum $type $($rest)*);
        $crate::payload!(@impl $name, $class, $type);
    };
    (@item $($item:tt)+) => {
        #[derive($crate::serde::Serialize, $crate::serde::Deserialize)]
        #[serde(crate = "::sinew::serde")]
        $($item)+
    };
    (@impl $name:literal, $class:ident, $type:ident) => {
        impl $crate::Payload for $type {
            const NAME: &'static str = $name;
            const CLASS: $crate::Class = $crate::Class::$class;
        }
    };
}
