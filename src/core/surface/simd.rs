//! Arithmetic of four numbers in parallel lanes, which the compiler turns into vector instructions. A formula that is
//! written for any [`Real`] works for one number and for four.

use std::ops::{Add, Div, Mul, Sub};

/// Number of lanes.
pub(crate) const LANES: usize = 4;

/// Number for computations: a single number, or four numbers in parallel lanes.
pub(crate) trait Real:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    /// Returns `value` as this type of number. If the type holds four numbers in parallel (four lanes), each of the
    /// four is `value`.
    fn splat(value: f64) -> Self;

    /// Returns the square root.
    fn sqrt(self) -> Self;

    /// Returns the unit vector in the direction of `v`. If the type holds four numbers in parallel (four lanes),
    /// returns four unit vectors. The type with four lanes multiplies by the reciprocal of the length; this needs one
    /// division instead of three.
    fn unit(v: &[Self; 3]) -> [Self; 3];

    /// Returns the sum `self + second + third`. The order of the two additions depends on the type. A type with a
    /// single number first adds `self` and `second`. A type with four parallel numbers first adds `second` and `third`,
    /// because this addition need not wait for `self`. The results of the two types can therefore differ by rounding.
    fn plus(self, second: Self, third: Self) -> Self;
}

/// One number for each of four points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct F64x4(pub(crate) [f64; LANES]);

/// Vectors of four points: x, y and z of all four.
pub(crate) type Vector3x4 = [F64x4; 3];

macro_rules! lanewise {
    ($trait:ident, $method:ident, $op:tt) => {
        impl $trait for F64x4 {
            type Output = F64x4;

            #[inline(always)]
            fn $method(self, other: F64x4) -> F64x4 {
                F64x4([
                    self.0[0] $op other.0[0],
                    self.0[1] $op other.0[1],
                    self.0[2] $op other.0[2],
                    self.0[3] $op other.0[3],
                ])
            }
        }
    };
}

lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);
lanewise!(Div, div, /);

impl Real for F64x4 {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        F64x4([value; LANES])
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        F64x4([self.0[0].sqrt(), self.0[1].sqrt(), self.0[2].sqrt(), self.0[3].sqrt()])
    }

    #[inline(always)]
    fn unit(v: &[Self; 3]) -> [Self; 3] {
        times(v, Self::splat(1.0) / dot(v, v).sqrt())
    }

    #[inline(always)]
    fn plus(self, second: Self, third: Self) -> Self {
        self + (second + third)
    }
}

impl Real for f64 {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        value
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }

    #[inline(always)]
    fn unit(v: &[Self; 3]) -> [Self; 3] {
        let norm = dot(v, v).sqrt();
        [v[0] / norm, v[1] / norm, v[2] / norm]
    }

    #[inline(always)]
    fn plus(self, second: Self, third: Self) -> Self {
        self + second + third
    }
}

impl F64x4 {
    /// Returns the smaller of two numbers in each lane.
    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        let least = |a: f64, b: f64| if a < b { a } else { b };
        F64x4([
            least(self.0[0], other.0[0]),
            least(self.0[1], other.0[1]),
            least(self.0[2], other.0[2]),
            least(self.0[3], other.0[3]),
        ])
    }
}

#[inline(always)]
pub(crate) fn dot<T: Real>(a: &[T; 3], b: &[T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<T: Real>(a: &[T; 3], b: &[T; 3]) -> [T; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(crate) fn minus<T: Real>(a: &[T; 3], b: &[T; 3]) -> [T; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn times<T: Real>(a: &[T; 3], b: T) -> [T; 3] {
    [a[0] * b, a[1] * b, a[2] * b]
}
