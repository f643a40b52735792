export function show() {}
export function reset() {}
export function setUp() {}
