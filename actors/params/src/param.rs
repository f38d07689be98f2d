//! A parameter that a control loop reads without a lock.

use std::{
    fmt,
    marker::PhantomData,
    sync::atomic::{AtomicU64, Ordering},
};

use crate::descriptor::Descriptor;

/// A parameter. The loop of its application reads it by [`get`](Self::get); only messages change it.
///
/// It changes between two ticks of its application, on the application's own thread. So all parameters that one tick
/// or one handler reads belong together. A reader on another thread may see one parameter of a set before another.
#[derive(Debug)]
pub struct Param<T> {
    cell: Cell,
    value_type: PhantomData<T>,
}

/// The value of a parameter as bits, and the value to which it moves.
#[derive(Debug)]
pub struct Cell {
    // SYNC: Relaxed; each parameter stands alone, and a reader of several is on the writer's thread.
    value: AtomicU64,
    target: AtomicU64,
    /// The target after a restart, if the parameter is kept: the present one, or one that a transaction applies soon.
    kept: AtomicU64,
}

/// The types of parameters: `f64`, `i64` and `bool`.
pub trait ParamType: Copy + fmt::Debug + sealed::Bits {}

mod sealed {
    pub trait Bits: Copy {
        fn to_bits(self) -> u64;
        fn of_bits(bits: u64) -> Self;
    }
}

impl sealed::Bits for f64 {
    fn to_bits(self) -> u64 {
        self.to_bits()
    }

    fn of_bits(bits: u64) -> Self {
        Self::from_bits(bits)
    }
}

impl sealed::Bits for i64 {
    fn to_bits(self) -> u64 {
        self.cast_unsigned()
    }

    fn of_bits(bits: u64) -> Self {
        bits.cast_signed()
    }
}

impl sealed::Bits for bool {
    fn to_bits(self) -> u64 {
        self.into()
    }

    fn of_bits(bits: u64) -> Self {
        bits != 0
    }
}

impl ParamType for f64 {}
impl ParamType for i64 {}
impl ParamType for bool {}

impl<T: ParamType> Param<T> {
    /// Creates a parameter with this value.
    pub fn new(value: T) -> Self {
        let bits = sealed::Bits::to_bits(value);
        let [value, target, kept] = [bits; 3].map(AtomicU64::new);
        Self { cell: Cell { value, target, kept }, value_type: PhantomData }
    }

    /// Returns the current value: one load, without a lock.
    #[must_use]
    #[inline]
    pub fn get(&self) -> T {
        T::of_bits(self.cell.value())
    }

    /// Returns the value to which it moves; the current value if it does not move.
    #[must_use]
    pub fn target(&self) -> T {
        T::of_bits(self.cell.target())
    }

    /// Returns the bits of the parameter, for its tuner.
    #[doc(hidden)]
    #[must_use]
    pub const fn cell(&self) -> &Cell {
        &self.cell
    }
}

impl Cell {
    #[inline]
    pub(crate) fn value(&self) -> u64 {
        self.value.load(Ordering::Relaxed)
    }

    pub(crate) fn target(&self) -> u64 {
        self.target.load(Ordering::Relaxed)
    }

    pub(crate) fn set_value(&self, bits: u64) {
        self.value.store(bits, Ordering::Relaxed);
    }

    pub(crate) fn set_target(&self, bits: u64) {
        self.target.store(bits, Ordering::Relaxed);
        self.set_kept(bits);
    }

    pub(crate) fn kept(&self) -> u64 {
        self.kept.load(Ordering::Relaxed)
    }

    pub(crate) fn set_kept(&self, bits: u64) {
        self.kept.store(bits, Ordering::Relaxed);
    }
}

/// A set of parameters of one application. `params!` implements it.
pub trait Parameters: Send + Sync + 'static {
    /// Returns the declarations, in the order of the struct.
    fn descriptors(&self) -> &'static [Descriptor];

    /// Returns the parameter of the declaration with this index.
    #[doc(hidden)]
    fn cell(&self, index: usize) -> Option<&Cell>;
}
