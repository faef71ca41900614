"""Find instructions of x86-64 libraries that not every x86-64 processor has.

An instruction belongs to the baseline if the disassembler puts it in a baseline group. An instruction without a group
belongs to the baseline if it is in the list below. Every other instruction counts as beyond, so the check also finds
instructions that the disassembler does not know well.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import capstone
from capstone import x86
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

#: The first x86-64 processors have x87, CMOV, MMX, SSE and SSE2. The other groups here are no extensions.
_BASELINE_GROUPS = {
    x86.X86_GRP_JUMP,
    x86.X86_GRP_CALL,
    x86.X86_GRP_RET,
    x86.X86_GRP_INT,
    x86.X86_GRP_BRANCH_RELATIVE,
    x86.X86_GRP_MODE64,
    x86.X86_GRP_CMOV,
    x86.X86_GRP_MMX,
    x86.X86_GRP_SSE1,
    x86.X86_GRP_SSE2,
    x86.X86_GRP_FPU,
}
_BASELINE = frozenset(
    """adc add and bsf bsr bswap bt btc btr bts cbw cdq cdqe cld cmp cmpsb cmpsq cmpxchg cpuid cqo cvtsi2sd cvtsi2ss cwd cwde dec
    div endbr64 hlt idiv imul inc int3 lea leave lodsb lodsq mov movabs movsb movsd movsq movsw movsx movsxd movzx mul neg nop not
    or pextrw pinsrw pop popfq push pushfq rcl rcr rol ror sar sbb scasb shl shld shr shrd std stosb stosd stosq stosw sub test
    ud2 xadd xchg xor""".split()  # noqa: SIM905  # as a list it would fill a page
)
#: The code that chooses between clones reads this register, after it has checked that it may.
_OF_CHOOSING = frozenset({"xgetbv"})
#: SSE3, although the disassembler puts it in the group of the x87.
_BEYOND = frozenset({"fisttp"})
#: Opcodes 0F 38 and 0F 3A came with SSSE3. One form of pextrw has such an opcode, another belongs to SSE2.
_LATER_OPCODES = ([0x0F, 0x38], [0x0F, 0x3A])
_SETS = tuple(
    f"set{condition}"
    for condition in ("a", "ae", "b", "be", "e", "g", "ge", "l", "le", "ne", "no", "np", "ns", "o", "p", "s")
)


def beyond_baseline(library: Path, *, without_clones: bool = False) -> Counter[str]:
    """Count each instruction beyond the baseline.

    Args:
        library: an ELF file for x86-64, not stripped.
        without_clones: leave out functions that run only after a check of the processor (gcc's ``target_clones``).

    Raises:
        ValueError: the file is not for x86-64, or holds bytes that are no instructions.
    """
    found: Counter[str] = Counter()
    left_out = _clones(library) if without_clones else []
    for instruction in _instructions(library):
        if not _is_baseline(instruction) and not any(instruction.address in clone for clone in left_out):
            found[instruction.mnemonic] += 1
    return found


def _is_baseline(instruction: capstone.CsInsn) -> bool:
    mnemonic = instruction.mnemonic.split()[-1]  # without lock and rep
    groups = set(instruction.groups)
    if mnemonic in _BEYOND or list(instruction.opcode[:2]) in _LATER_OPCODES or not groups <= _BASELINE_GROUPS:
        return False
    return bool(groups) or mnemonic in _BASELINE | _OF_CHOOSING or mnemonic in _SETS


def _instructions(library: Path) -> Iterator[capstone.CsInsn]:
    decoder = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
    decoder.detail = True
    with library.open("rb") as file:
        elf = ELFFile(file)
        if elf.get_machine_arch() != "x64":
            raise ValueError(f"{library.name} is for {elf.get_machine_arch()}, not for x86-64")
        for section in elf.iter_sections():
            if not section["sh_flags"] & 4 or section["sh_type"] == "SHT_NOBITS":  # flag 4 is SHF_EXECINSTR
                continue
            code, begin = section.data(), section["sh_addr"]
            end = begin
            for instruction in decoder.disasm(code, begin):
                end = instruction.address + instruction.size
                yield instruction
            if end - begin != len(code):
                raise ValueError(f"{library.name}: {section.name} has no instruction at {end:#x}")


def _clones(library: Path) -> list[range]:
    with library.open("rb") as file:
        tables = [each for each in ELFFile(file).iter_sections() if isinstance(each, SymbolTableSection)]
        symbols = [symbol for table in tables for symbol in table.iter_symbols() if ".avx2" in symbol.name]
        return [range(symbol["st_value"], symbol["st_value"] + symbol["st_size"]) for symbol in symbols]
