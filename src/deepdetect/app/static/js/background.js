// A worker whose tasks are called as functions that return promises.

export class Background {
  constructor(url) {
    this.calls = new Map();
    this.next = 0;
    this.worker = new Worker(url, { type: "module" });
    this.worker.onmessage = ({ data: { id, result, error } }) => {
      const call = this.calls.get(id);
      this.calls.delete(id);
      if (error === undefined) call.resolve(result);
      else call.reject(new Error(error));
    };
    this.worker.onerror = (event) => {
      event.preventDefault();
      for (const call of this.calls.values()) {
        call.reject(new Error("This browser is too old for the page: use a newer one."));
      }
      this.calls.clear();
    };
  }

  /** @param {string} task @param {object} values @returns {Promise<any>} */
  call(task, values, transfer = []) {
    const id = this.next++;
    return new Promise((resolve, reject) => {
      this.calls.set(id, { resolve, reject });
      this.worker.postMessage({ id, task, values }, transfer);
    });
  }
}
