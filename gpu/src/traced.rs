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
use cubecl::ir::dialect::bitwise::BitwiseXorOp;
use cubecl::ir::dialect::cmp::{FLessThanOp, ULessThanOp};
use cubecl::ir::dialect::general::{BoolAndOp, BoolNotOp, BoolOrOp, SelectOp};
use cubecl::ir::dialect::math::{
    ExpOp, FAbsOp, FAddOp, FDivOp, FMulOp, FNegOp, FSubOp, IAddOp, IMulOp, LogOp, RoundOp, SqrtOp, UMulHiOp,
};
use cubecl::ir::{ConstantValue, ExpandValue, FloatKind};
use cubecl::prelude::*;
use flight::math::Real;

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
        if Self::is_double() { flight::math::natural_log(self) } else { Self::new(emit!(LogOp, self)) }
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

/// Variables of a kernel, in registers.
struct Variables<const N: usize>([ExpandValue; N]);

impl<const N: usize> Variables<N> {
    fn new<T: CubePrimitive>(scope: &Scope, values: [ExpandValue; N]) -> Self {
        let ty = T::__expand_as_type(scope);
        Self(values.map(|value| {
            let variable = ExpandValue::from(scope.create_local_mut(ty, None));
            assign::expand_element(scope, value, variable);
            variable
        }))
    }

    fn read(&self, scope: &Scope) -> [ExpandValue; N] {
        self.0.map(|variable| ExpandValue::Value(variable.read_value(scope)))
    }

    fn write(&self, scope: &Scope, values: [ExpandValue; N]) {
        for (variable, value) in self.0.into_iter().zip(values) {
            assign::expand_element(scope, value, variable);
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

    fn repeat<const N: usize>(
        count: u32,
        values: [Self; N],
        mut step: impl FnMut([Self; N]) -> [Self; N],
    ) -> [Self; N] {
        scope(|scope| {
            let variables = Variables::new::<F>(scope, values.map(|value| value.0));
            let [first, last] = [0, count].map(|at| NativeExpand::<u32>::from_lit(scope, at));
            for_expand(scope, RangeExpand::<u32>::new(first, last), false, |scope, _| {
                within(scope, || {
                    let next = step(variables.read(scope).map(Self::new));
                    variables.write(scope, next.map(|value| value.0));
                });
            });
            variables.read(scope).map(Self::new)
        })
    }

    fn when<const N: usize, const K: usize>(
        mask: TracedMask,
        values: ([Self; N], [TracedWord; K]),
        change: impl FnOnce() -> ([Self; N], [TracedWord; K]),
    ) -> ([Self; N], [TracedWord; K]) {
        scope(|scope| {
            let numbers = Variables::new::<F>(scope, values.0.map(|value| value.0));
            let words = Variables::new::<u32>(scope, values.1.map(|value| value.0));
            if_expand(scope, mask.0.into(), |scope| {
                within(scope, || {
                    let (new_numbers, new_words) = change();
                    numbers.write(scope, new_numbers.map(|value| value.0));
                    words.write(scope, new_words.map(|value| value.0));
                });
            });
            (numbers.read(scope).map(Self::new), words.read(scope).map(TracedWord))
        })
    }
}
