use pulp::WithSimd;

use super::LANES;
use crate::names::named_enum;

named_enum! {
    "instruction set"
    /// The instructions that lanes are advanced with, narrowest first. The results are the same bits.
    pub enum Width {
        /// What every machine has: two numbers at once on x86-64.
        Portable = "portable",
        /// AVX2: four numbers.
        Avx2 = "avx2",
        /// AVX-512: eight numbers.
        Avx512 = "avx512",
    }
}

impl Width {
    /// Those that this machine has, narrowest first.
    pub fn available() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|width| width.is_available())
    }

    /// The widest that this machine has.
    pub fn best() -> Self {
        Self::available().last().unwrap_or(Self::Portable)
    }

    /// Whether this machine has them.
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::is_available(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => pulp::x86::V4::is_available(),
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// Runs work on the first `count` lanes with these instructions, or with what there is. Lanes that fit half a register are computed
    /// in halves: the machine does twice as many of them at once.
    #[inline]
    pub(super) fn run<W: WithSimd>(self, count: usize, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        match self {
            Self::Avx512 => {
                if let Some(simd) = pulp::x86::V4::try_new() {
                    if count <= LANES / 2 {
                        return simd.vectorize(InHalves(simd, work));
                    }
                    return pulp::Simd::vectorize(simd, work);
                }
            }
            Self::Avx2 => {
                if let Some(simd) = pulp::x86::V3::try_new() {
                    return pulp::Simd::vectorize(simd, work);
                }
            }
            Self::Portable => {}
        }
        work.with_simd(pulp::Scalar128b)
    }
}

/// Work in the lower halves of AVX-512's 32 registers.
#[cfg(target_arch = "x86_64")]
struct InHalves<W>(pulp::x86::V4, W);

#[cfg(target_arch = "x86_64")]
impl<W: WithSimd> pulp::NullaryFnOnce for InHalves<W> {
    type Output = W::Output;

    #[inline(always)]
    fn call(self) -> W::Output {
        let Self(simd, work) = self;
        work.with_simd(*simd)
    }
}
