@ Branches that the assembler leaves to the linker, and addresses in two halves.
    .syntax unified
    .cpu cortex-m3
    .thumb
    .section .text.jumps, "ax"
    .global jumps, near
    .type jumps, %function
    .type near, %function
    .thumb_func
jumps:
    movw r0, #:lower16:app_config + 4
    movt r0, #:upper16:app_config + 4
    bl r2p_sleep
    beq.w r2p_near
    bl hook
    b.w finish
    .thumb_func
short:
    b.n near
    bne.n near
    bx lr
    .align 2
    .word near - .
    .word state_of_firmware + 12
    .size jumps, . - jumps
    .section .text.near, "ax"
    .thumb_func
near:
    bx lr
    .weak hook
