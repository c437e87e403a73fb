//! Numbers and words of a kernel that is being built: the equations of the CPU, called once on the host with these
//! types, emit the operations of the kernel.
//!
//! A kernel has no branches on numbers. Everything that a trace depends on is therefore known when the kernel is
//! built, and belongs to its compile-time arguments.

use std::cell::Cell;
use std::marker::PhantomData;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use cubecl::frontend::RangeExpand;
use cubecl::frontend::assign;
use cubecl::frontend::branch::{for_expand, if_expand};
use cubecl::ir::dialect::bitwise::{BitwiseAndOp, BitwiseXorOp};
use cubecl::ir::dialect::cmp::{FLessThanOp, ULessThanOp};
use cubecl::ir::dialect::general::{BoolAndOp, BoolNotOp, BoolOrOp, SelectOp};
use cubecl::ir::dialect::math::{
    ExpOp, FAbsOp, FAddOp, FDivOp, FMulOp, FNegOp, FSubOp, IAddOp, IMulOp, LogOp, RoundOp, SqrtOp, UMulHiOp,
};
use cubecl::ir::{ConstantValue, ExpandValue, FloatKind};
use cubecl::prelude::*;
use flight::math::{Bits, Real};
use flight::random::Sampled;

use crate::kernel::{load, store};
use crate::number::{Number, Word};

thread_local! {
    static SCOPE: Cell<*const Scope> = const { Cell::new(std::ptr::null()) };
}

/// Calls `work` with `scope` as the place where traced operations are emitted.
pub(crate) fn within<R>(scope: &Scope, work: impl FnOnce() -> R) -> R {
    /// Restores the scope of the caller, also after a panic.
    struct Restore(*const Scope);
    impl Drop for Restore {
        fn drop(&mut self) {
            SCOPE.set(self.0);
        }
    }
    let _restore = Restore(SCOPE.replace(scope));
    work()
}

/// Workgroup whose threads exchange numbers.
///
/// The numbers are in a buffer of the device, with a barrier for the threads of a workgroup: Mesa 22.3 cannot compile
/// the shared memory of cubecl.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Group {
    /// A row of `threads` numbers for each of [`Group::ROWS`] numbers.
    exchange: ExpandValue,
    /// Number of threads in all workgroups.
    threads: NativeExpand<usize>,
    /// Number of this thread.
    position: NativeExpand<usize>,
    /// Drones of a world, which are neighbours.
    drones: u32,
}

impl Group {
    /// Largest number of numbers that are exchanged at a time.
    pub const ROWS: usize = 12;

    /// Describes the workgroup of a thread; `None` for worlds of one drone.
    pub fn new<F: Float>(
        exchange: &NativeExpand<[F]>,
        drones: u32,
        threads: NativeExpand<usize>,
        position: NativeExpand<usize>,
    ) -> Option<Self> {
        (drones > 1).then_some(Self { exchange: exchange.expand, threads, position, drones })
    }

    fn at(&self, scope: &Scope, row: usize, position: NativeExpand<usize>) -> NativeExpand<usize> {
        let row = NativeExpand::<usize>::from_lit(scope, row);
        row.__expand_mul_method(scope, self.threads).__expand_add_method(scope, position)
    }

    /// Returns the numbers of every drone of this thread's world.
    fn gather<F: Float>(&self, scope: &Scope, own: &[Traced<F>]) -> Vec<Vec<Traced<F>>> {
        assert!(own.len() <= Self::ROWS, "the buffer has room for {} numbers", Self::ROWS);
        let mut exchange: NativeExpand<[F]> = self.exchange.into();
        for (row, number) in own.iter().enumerate() {
            store(scope, &mut exchange, self.at(scope, row, self.position), number.0);
        }
        sync_storage::expand(scope);
        let drones = NativeExpand::from_lit(scope, self.drones as usize);
        let first = self.position.__expand_sub_method(scope, self.position.__expand_rem_method(scope, drones));
        let drone = |index: usize| first.__expand_add_method(scope, NativeExpand::from_lit(scope, index));
        let numbers = |index: usize| -> Vec<Traced<F>> {
            (0..own.len()).map(|row| Traced::new(load(scope, &exchange, self.at(scope, row, drone(index))))).collect()
        };
        let all = (0..self.drones as usize).map(numbers).collect();
        // before the next numbers replace these
        sync_storage::expand(scope);
        all
    }
}

thread_local! {
    static GROUP: Cell<Option<Group>> = const { Cell::new(None) };
}

/// Calls `work` in a workgroup.
pub(crate) fn within_group<R>(group: Option<Group>, work: impl FnOnce() -> R) -> R {
    /// Removes the workgroup, also after a panic.
    struct Remove;
    impl Drop for Remove {
        fn drop(&mut self) {
            GROUP.set(None);
        }
    }
    let _remove = Remove;
    GROUP.set(group);
    work()
}

#[allow(unsafe_code)]
fn scope<R>(work: impl FnOnce(&Scope) -> R) -> R {
    let scope = SCOPE.get();
    assert!(!scope.is_null(), "a traced operation outside of a kernel");
    // SAFETY: `within` borrows the scope for as long as the pointer to it is set, on this thread alone
    work(unsafe { &*scope })
}

/// Number of a kernel, of the type `F`.
#[derive(Debug)]
pub(crate) struct Traced<F>(pub ExpandValue, PhantomData<F>);

impl<F> Clone for Traced<F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F> Copy for Traced<F> {}

/// Truth value of a kernel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TracedMask(pub ExpandValue);

/// 32-bit integer of a kernel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TracedWord(pub ExpandValue);

/// Emits an operation and returns its result.
macro_rules! emit {
    ($op:ident, $($operand:expr),+) => {
        scope(|scope| {
            let op = $op::new(scope.ctx_mut(), $($operand.0.read_value(scope)),+);
            ExpandValue::Value(scope.register_with_result(&op))
        })
    };
}

impl<F: Float> Traced<F> {
    /// Creates the number of a value of the type `F`.
    pub fn new(value: impl Into<ExpandValue>) -> Self {
        Self(value.into(), PhantomData)
    }

    /// Creates a constant.
    pub fn constant(x: f64) -> Self {
        Self::new(scope(|scope| ExpandValue::constant(ConstantValue::Float(x), F::elem_type(scope))))
    }

    /// Returns true if `F` is `f64`.
    fn is_double() -> bool {
        scope(|scope| F::elem_type(scope)) == ElemType::Float(FloatKind::F64)
    }
}

macro_rules! operators {
    ($($operator:ident $name:ident $op:ident;)*) => {$(
        impl<F: Float> $operator for Traced<F> {
            type Output = Self;

            fn $name(self, other: Self) -> Self {
                Self::new(emit!($op, self, other))
            }
        }

        impl<F: Float> $operator<f64> for Traced<F> {
            type Output = Self;

            fn $name(self, other: f64) -> Self {
                $operator::$name(self, Self::constant(other))
            }
        }
    )*};
}

operators! {
    Add add FAddOp;
    Sub sub FSubOp;
    Mul mul FMulOp;
    Div div FDivOp;
}

impl<F: Float> Neg for Traced<F> {
    type Output = Self;

    fn neg(self) -> Self {
        Self::new(emit!(FNegOp, self))
    }
}

impl BitAnd for TracedMask {
    type Output = Self;

    fn bitand(self, other: Self) -> Self {
        Self(emit!(BoolAndOp, self, other))
    }
}

impl BitOr for TracedMask {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(emit!(BoolOrOp, self, other))
    }
}

impl Not for TracedMask {
    type Output = Self;

    fn not(self) -> Self {
        Self(emit!(BoolNotOp, self))
    }
}

/// The arctangents keep their arithmetic form: the precision of the device's own functions is a thousand times lower
/// by Vulkan's rules, and their double-precision forms do not exist.
impl<F: Float> Real for Traced<F> {
    type Mask = TracedMask;

    // of the narrower type: both can represent it
    const MIN_POSITIVE: f64 = f32::MIN_POSITIVE as f64;

    fn all(self, x: f64) -> Self {
        Self::constant(x)
    }

    fn abs(self) -> Self {
        Self::new(emit!(FAbsOp, self))
    }

    fn sqrt(self) -> Self {
        Self::new(emit!(SqrtOp, self))
    }

    fn less(self, other: Self) -> TracedMask {
        TracedMask(emit!(FLessThanOp, self, other))
    }

    fn choose(mask: TracedMask, yes: Self, no: Self) -> Self {
        Self::new(emit!(SelectOp, mask, yes, no))
    }

    fn any(_: TracedMask) -> bool {
        // unknown while the kernel is built
        true
    }

    fn with_sign_of(self, other: Self) -> Self {
        let magnitude = self.abs();
        Self::choose(other.less(other.all(0.0)), -magnitude, magnitude)
    }

    fn rounded(self) -> Self {
        // drivers may simplify a sum and a difference of the same constant
        Self::new(emit!(RoundOp, self))
    }

    fn exp_of_negative(self) -> Self {
        // the exponential and the logarithm of the device exist in single precision alone
        if Self::is_double() { flight::math::exponential(self) } else { Self::new(emit!(ExpOp, self)) }
    }

    fn natural_log(self) -> Self {
        if Self::is_double() {
            return flight::math::natural_log(self);
        }
        // devices may round the logarithm of a number just below one to a positive number
        let (log, one, zero) = (Self::new(emit!(LogOp, self)), self.all(1.0), self.all(0.0));
        Self::choose(one.less(self), log, log.lesser(zero))
    }
}

impl Word for TracedWord {
    type Mask = TracedMask;

    fn of(x: u32) -> Self {
        Self(scope(|scope| ExpandValue::constant(ConstantValue::UInt(u64::from(x)), u32::elem_type(scope))))
    }

    fn plus(self, other: Self) -> Self {
        Self(emit!(IAddOp, self, other))
    }

    fn times(self, other: Self) -> Self {
        Self(emit!(IMulOp, self, other))
    }

    fn times_high(self, other: Self) -> Self {
        Self(emit!(UMulHiOp, self, other))
    }

    fn xor(self, other: Self) -> Self {
        Self(emit!(BitwiseXorOp, self, other))
    }

    fn less(self, other: Self) -> TracedMask {
        TracedMask(emit!(ULessThanOp, self, other))
    }

    fn choose(mask: TracedMask, yes: Self, no: Self) -> Self {
        Self(emit!(SelectOp, mask, yes, no))
    }
}

/// 64-bit integer of a kernel, whose device may have integers of 32 bits alone.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TracedInteger {
    low: TracedWord,
    high: TracedWord,
}

impl TracedWord {
    fn and(self, mask: u32) -> Self {
        let mask = Self::of(mask);
        Self(emit!(BitwiseAndOp, self, mask))
    }

    /// Returns the larger of two sums that differ by one where the mask is true.
    fn plus_one_where(self, mask: TracedMask) -> Self {
        Self::choose(mask, self.plus(Self::of(1)), self)
    }

    fn minus(self, other: Self) -> Self {
        // the two's complement
        self.plus(other.xor(Self::of(u32::MAX))).plus(Self::of(1))
    }
}

/// Halves of an integer.
fn halves(x: u64) -> [u32; 2] {
    [x as u32, (x >> 32) as u32]
}

impl Bits for TracedInteger {
    fn all(self, x: u64) -> Self {
        let [low, high] = halves(x).map(TracedWord::of);
        Self { low, high }
    }

    fn and(self, mask: u64) -> Self {
        let [low, high] = halves(mask);
        Self { low: self.low.and(low), high: self.high.and(high) }
    }

    fn or(self, bits: u64) -> Self {
        // a | b = (a & ¬b) ^ b
        let kept = self.and(!bits);
        kept.xor(kept.all(bits))
    }

    fn xor(self, other: Self) -> Self {
        Self { low: self.low.xor(other.low), high: self.high.xor(other.high) }
    }

    fn plus(self, other: Self) -> Self {
        let low = self.low.plus(other.low);
        let carry = low.less(self.low);
        Self { low, high: self.high.plus(other.high).plus_one_where(carry) }
    }

    fn minus(self, other: Self) -> Self {
        let borrow = self.low.less(other.low);
        let high = self.high.minus(other.high);
        let less = high.minus(TracedWord::of(1));
        Self { low: self.low.minus(other.low), high: TracedWord::choose(borrow, less, high) }
    }

    fn lower_times(self, factor: u32) -> Self {
        let factor = TracedWord::of(factor);
        Self { low: self.low.times(factor), high: self.low.times_high(factor) }
    }

    fn swap_halves(self) -> Self {
        Self { low: self.high, high: self.low }
    }
}

impl<F: Float> Sampled for Traced<F> {
    type Integer = TracedInteger;

    fn from_integer(integer: TracedInteger) -> Self {
        Self::of_word(integer.low) + Self::of_word(integer.high) * 4_294_967_296.0
    }

    fn negated_by(self, integer: TracedInteger) -> Self {
        let negative = TracedWord::of(0x7fff_ffff).less(integer.high);
        Self::choose(negative, -self, self)
    }
}

/// Variables of a kernel, in registers.
struct Variables(Vec<ExpandValue>);

impl Variables {
    fn new<T: CubePrimitive>(scope: &Scope, values: impl Iterator<Item = ExpandValue>) -> Self {
        let ty = T::__expand_as_type(scope);
        let variable = |value| {
            let variable = ExpandValue::from(scope.create_local_mut(ty, None));
            assign::expand_element(scope, value, variable);
            variable
        };
        Self(values.map(variable).collect())
    }

    fn read(&self, scope: &Scope) -> impl Iterator<Item = ExpandValue> {
        self.0.iter().map(|variable| ExpandValue::Value(variable.read_value(scope)))
    }

    fn write(&self, scope: &Scope, values: impl ExactSizeIterator<Item = ExpandValue>) {
        assert_eq!(self.0.len(), values.len(), "a branch or a loop keeps the number of its values");
        for (variable, value) in self.0.iter().zip(values) {
            assign::expand_element(scope, value, *variable);
        }
    }
}

impl<F: Float> Number for Traced<F> {
    type Word = TracedWord;

    fn of_word(word: TracedWord) -> Self {
        Self::new(scope(|scope| {
            let value = word.0.read_value(scope);
            ExpandValue::Value(cubecl::frontend::cast_value(scope, value, F::__expand_as_type(scope)))
        }))
    }

    fn wide(low: TracedWord, high: TracedWord) -> TracedInteger {
        TracedInteger { low, high }
    }

    fn repeat(count: u32, values: Vec<Self>, mut step: impl FnMut(TracedWord, Vec<Self>) -> Vec<Self>) -> Vec<Self> {
        scope(|scope| {
            let variables = Variables::new::<F>(scope, values.into_iter().map(|value| value.0));
            let [first, last] = [0, count].map(|at| NativeExpand::<u32>::from_lit(scope, at));
            for_expand(scope, RangeExpand::<u32>::new(first, last), false, |scope, index| {
                within(scope, || {
                    let next = step(TracedWord(index.expand), variables.read(scope).map(Self::new).collect());
                    variables.write(scope, next.into_iter().map(|value| value.0));
                });
            });
            variables.read(scope).map(Self::new).collect()
        })
    }

    fn when(
        mask: TracedMask,
        values: (Vec<Self>, Vec<TracedWord>),
        change: impl FnOnce() -> (Vec<Self>, Vec<TracedWord>),
    ) -> (Vec<Self>, Vec<TracedWord>) {
        scope(|scope| {
            let numbers = Variables::new::<F>(scope, values.0.into_iter().map(|value| value.0));
            let words = Variables::new::<u32>(scope, values.1.into_iter().map(|value| value.0));
            if_expand(scope, mask.0.into(), |scope| {
                within(scope, || {
                    let (new_numbers, new_words) = change();
                    numbers.write(scope, new_numbers.into_iter().map(|value| value.0));
                    words.write(scope, new_words.into_iter().map(|value| value.0));
                });
            });
            (numbers.read(scope).map(Self::new).collect(), words.read(scope).map(TracedWord).collect())
        })
    }

    fn gather(drones: u32, own: &[Self]) -> Vec<Vec<Self>> {
        if drones == 1 {
            return vec![own.to_vec()];
        }
        let Some(group) = GROUP.get() else { unreachable!("drones of a world exchange numbers in a control step") };
        scope(|scope| group.gather(scope, own))
    }
}
